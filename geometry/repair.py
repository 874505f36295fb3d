"""Twin minus scan: watertight patches with volume, for the repair shop."""

from dataclasses import dataclass

from geometry.types import Measurand, Mesh, Zone


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patch:
    """The metal to put back for one damage: a closed, oriented solid in the nominal frame."""

    damage: int  # index into the damages it was made for
    zone: Zone
    mesh: Mesh
    watertight: bool
    volume_mm3: Measurand
    volume_check_mm3: float  # by an independent second method


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RepairVolume:
    """All patches, their total, and why a damage has none: `failures` maps damage index to reason."""

    patches: tuple[Patch, ...]
    volume_mm3: Measurand
    failures: dict[int, str]
