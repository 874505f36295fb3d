"""Values that every measuring step shares: points in, numbers with a sigma out."""

from dataclasses import dataclass
from enum import StrEnum
from math import isfinite
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from geometry.errors import BadInput

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Unit = Literal["mm", "mm2", "mm3", "deg", "1"]


class Zone(StrEnum):
    """Where on the blade; damage limits are written by zone."""

    TIP = "tip"
    LEADING_EDGE = "leading_edge"
    TRAILING_EDGE = "trailing_edge"
    SURFACE = "surface"
    OUTSIDE = "outside"


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurand:
    """One number that can fail a part, with its standard uncertainty.

    `value` and `sigma` are in `unit`; both are finite, `sigma >= 0`.
    """

    name: str
    value: float
    sigma: float
    unit: Unit

    def __post_init__(self) -> None:
        if not (isfinite(self.value) and isfinite(self.sigma) and self.sigma >= 0.0):
            raise BadInput(f"{self.name}: {self.value} +- {self.sigma} is not a measured value")


@dataclass(frozen=True, slots=True, kw_only=True)
class NotMeasured:
    """Why there is no number. `in_damage`: its support touches a damage, whose limits judge it."""

    reason: str
    in_damage: bool = False


Measured = Measurand | NotMeasured


def frozen_points(points_mm: object, name: str, columns: int = 3) -> Floats:
    """A read-only C-contiguous float64 copy-if-needed of shape (n, columns), all finite."""
    array = np.ascontiguousarray(points_mm, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != columns:
        raise BadInput(f"{name}: shape {array.shape}, want (n, {columns})")
    if not np.isfinite(array).all():
        raise BadInput(f"{name}: has values that are not finite")
    if array.flags.writeable:
        array = array.view()
        array.flags.writeable = False
    return array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """One capture: points in the scanner frame and the table angle at which they were taken."""

    index: int
    angle_deg: float
    points_mm: Floats  # (n, 3), scanner frame

    def __post_init__(self) -> None:
        object.__setattr__(self, "points_mm", frozen_points(self.points_mm, "view points"))
        if not isfinite(self.angle_deg):
            raise BadInput(f"view {self.index}: angle {self.angle_deg} is not finite")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cloud:
    """Scan points of one part in one frame ("scan": the table frame at 0 deg, or a file's own).

    `sigma_mm` (n,): standard uncertainty of each point along the surface normal.
    `view` (n,): the view that each point came from, 0 for a merged file.
    """

    points_mm: Floats
    sigma_mm: Floats
    view: Ints

    def __post_init__(self) -> None:
        object.__setattr__(self, "points_mm", frozen_points(self.points_mm, "cloud points"))
        count = len(self.points_mm)
        if self.sigma_mm.shape != (count,) or self.view.shape != (count,):
            raise BadInput(f"cloud: {count} points, {self.sigma_mm.shape} sigmas, {self.view.shape} views")
        if not (np.isfinite(self.sigma_mm).all() and (self.sigma_mm > 0.0).all()):
            raise BadInput("cloud: a sigma is not a positive number")

    def __len__(self) -> int:
        return len(self.points_mm)

    def of(self, chosen: Bools | Ints) -> "Cloud":
        """The chosen points, by flag or index, and nothing else that the cloud may bring along."""
        return Cloud(points_mm=self.points_mm[chosen], sigma_mm=self.sigma_mm[chosen], view=self.view[chosen])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Mesh:
    """A triangle mesh: `vertices_mm` (n, 3), `faces` (m, 3), counter-clockwise seen from outside."""

    vertices_mm: Floats
    faces: Ints

    def __post_init__(self) -> None:
        object.__setattr__(self, "vertices_mm", frozen_points(self.vertices_mm, "mesh vertices"))
        faces = np.ascontiguousarray(self.faces, dtype=np.int64)
        if faces.ndim != 2 or faces.shape[1] != 3:
            raise BadInput(f"mesh faces: shape {faces.shape}, want (m, 3)")
        if len(faces) and (faces.min() < 0 or faces.max() >= len(self.vertices_mm)):
            raise BadInput("mesh faces: an index is outside the vertices")
        object.__setattr__(self, "faces", faces)
