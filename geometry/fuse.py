"""Views + axis calibration -> one cloud, and how well the views agree where they overlap."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from geometry.calibrate import AxisCalibration
from geometry.errors import CannotMeasure
from geometry.kernels.neighbours import k_nearest
from geometry.kernels.quadric import balanced_quadrics
from geometry.transforms import about_z, apply, inverse
from geometry.types import Bools, Cloud, Floats, View

NEIGHBOURS = 16
OTHERS = 4  # points of other views among the neighbours that make an overlap
FLAT_PER_MM = 0.05  # where the surface bends more, a chord's height is no disagreement


@dataclass(frozen=True, slots=True, kw_only=True)
class Overlap:
    """How one view lies on all others, along the surface normal.

    `bias_mm` is the rms of what the best rigid motion of the view would correct: a view that is noisy but
    in its place has a large `rms_mm` and no bias. Nothing is corrected here.
    """

    view: int
    points: int  # that have enough neighbours of other views
    rms_mm: float
    bias_mm: float


def fuse(views: Sequence[View], axis: AxisCalibration, sigma_mm: float) -> Cloud:
    """The points of all views in the table frame at 0 deg, in the order given.

    `sigma_mm` is the standard uncertainty of a point along the surface normal. Raises `CannotMeasure`
    without a point.
    """
    moved = [apply(inverse(axis.T_scanner_table0 @ about_z(v.angle_deg)), v.points_mm) for v in views]
    points_mm = np.concatenate([np.zeros((0, 3)), *moved])
    if len(points_mm) == 0:
        raise CannotMeasure(f"{len(views)} views without a point")
    return Cloud(
        points_mm=points_mm,
        sigma_mm=np.full(len(points_mm), sigma_mm),
        view=np.repeat([v.index for v in views], [len(v.points_mm) for v in views]).astype(np.int64),
    )


def overlaps(cloud: Cloud, most_points: int = 200_000) -> tuple[Overlap, ...]:
    """How each view of the cloud agrees with the others; a view without enough overlap is absent.

    A point's disagreement is its height above the mean of its neighbours of other views, along the local
    normal, where the surface is nearly flat. Every n-th point is taken so that `most_points` are.
    """
    taken = slice(None, None, max(1, len(cloud) // most_points))
    points_mm, view = cloud.points_mm[taken], cloud.view[taken]
    if len(points_mm) < NEIGHBOURS:
        return ()
    nearest, _ = k_nearest(points_mm, NEIGHBOURS)
    _, normals, _, bend_per_mm, _ = balanced_quadrics(points_mm, nearest, 8, 2)
    other = view[nearest] != view[:, None]
    found = other.sum(axis=1)
    mean_mm = np.einsum("nk,nkj->nj", other, points_mm[nearest]) / np.maximum(found, 1)[:, None]
    height_mm = np.einsum("nj,nj->n", points_mm - mean_mm, normals)
    usable = (found >= OTHERS) & (np.abs(bend_per_mm) < FLAT_PER_MM) & np.isfinite(height_mm)
    each = [_overlap(points_mm, normals, height_mm, usable & (view == v), int(v)) for v in np.unique(view)]
    return tuple(o for o in each if o is not None)


def _overlap(points_mm: Floats, normals: Floats, height_mm: Floats, mine: Bools, view: int) -> Overlap | None:
    count = int(mine.sum())
    if count < 50:
        return None
    local_mm, n, height = points_mm[mine] - points_mm[mine].mean(axis=0), normals[mine], height_mm[mine]
    motions = np.column_stack([np.cross(local_mm, n), n])
    twist, *_ = np.linalg.lstsq(motions, height, rcond=1e-6)
    return Overlap(
        view=view,
        points=count,
        rms_mm=float(np.sqrt(np.mean(height**2))),
        bias_mm=float(np.sqrt(np.mean((motions @ twist) ** 2))),
    )
