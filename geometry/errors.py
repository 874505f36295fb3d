"""What could not be measured.

    GeometryError
    ├── BadInput            the data or the settings contradict themselves
    │   └── BadMesh         a nominal that is not a closed, oriented solid, or lacks an airfoil
    └── CannotMeasure       readable, but not enough to give the number asked for
        ├── CannotRegister
        ├── CannotFitTwin
        └── CannotRepair

A function that measures several things returns `NotMeasured(reason)` for the one that it could
not; it raises `CannotMeasure` when nothing that it was asked for exists.
"""


class GeometryError(Exception):
    """Any failure of this room; its text is one clear line for a person."""


class BadInput(GeometryError):
    """The data or the settings contradict themselves."""


class BadMesh(BadInput):
    """The nominal is not a closed, consistently oriented solid, or has no airfoil."""


class CannotMeasure(GeometryError):
    """Readable but insufficient data."""


class CannotRegister(CannotMeasure):
    """No pose of the scan on the nominal could be found."""


class CannotFitTwin(CannotMeasure):
    """The damage-free twin could not be fitted."""


class CannotRepair(CannotMeasure):
    """No valid repair solid could be made for a damage."""
