"""The lost volume by a second way: columns between the scan points of a break and the twin's skin."""

import numpy as np
from scipy.spatial import cKDTree

from geometry.damage.broken import BrokenSurface
from geometry.damage.local_shape import frames_along, quadric_terms
from geometry.damage.skin import Skin
from geometry.errors import CannotRepair
from geometry.kernels.implicit_solid import column_crossings
from geometry.types import Floats

RIM_FACING = 0.3  # least cosine to the way out of skin on which the columns may stand
LEAST_FACING = 0.15  # of the mean normal of a break that columns can measure
COLUMNS = 40_000  # over the box of the damage
NEAREST = 16  # points that tell how high the break lies in a column
RIDGE = (1e-9, 1e-9, 1e-9, 1e-3, 1e-3, 1e-3)  # how far a plane is preferred where few points tell a bend


def volume_by_columns(broken: BrokenSurface, skin: Skin) -> float:
    """The lost volume (mm3) by another way: columns along the way out, from scan points to the twin's skin.

    Uses neither the local shape of the break nor the implicit surface nor the mesh of the patch: a column
    ends on a quadric through the nearest scan points in projection, of the break and of those of its rim
    that face the same way; it counts where it leaves the twin through lost skin or just beside it.
    """
    facing = float(np.linalg.norm(broken.facing))
    if not facing > LEAST_FACING:
        raise CannotRepair("the broken surface wraps around: its volume has no second way to check it")
    R = frames_along(broken.facing[None] / facing)[0].T
    raw, lost = broken.raw_mm @ R, broken.lost_mm @ R
    rim = broken.rim.points_mm[broken.rim.normals @ R[:, 2] > RIM_FACING] @ R
    ends = np.concatenate([raw, lost])
    low, high = ends.min(axis=0) - 0.5, ends.max(axis=0) + 0.5
    pitch_mm = float(np.sqrt(np.prod(high[:2] - low[:2]) / COLUMNS))
    shape = (int((high[0] - low[0]) / pitch_mm) + 1, int((high[1] - low[1]) / pitch_mm) + 1)
    start, height = column_crossings(skin.triangles_mm @ R, low[:2], pitch_mm, shape)
    column = np.repeat(np.arange(len(start) - 1), np.diff(start))[::2]
    enter, leave = height[::2], height[1::2]
    at = low[:2] + pitch_mm * np.column_stack([column // shape[1], column % shape[1]])
    gone = cKDTree(lost).query(np.column_stack([at, leave]))[0] <= broken.lost_reach_mm
    at, enter, leave = at[gone], enter[gone], leave[gone]
    floor = _heights(at, np.concatenate([raw, rim]))
    below = leave - floor
    length = np.where(below > -broken.film_mm, np.minimum(below, leave - enter), 0.0)
    return float(length.sum()) * pitch_mm**2


def _heights(at_mm: Floats, points_mm: Floats) -> Floats:
    """Height (n,) over each place (n, 2) of a weighted quadric through the points nearest in projection.

    Between the points of a rounded edge a plane would cut the corner.
    """
    near = np.arange(1, min(NEAREST, len(points_mm)) + 1)
    distance_mm, index = cKDTree(points_mm[:, :2]).query(at_mm, near)
    reach_mm = distance_mm[:, -1:]
    weight = 1.0 / ((distance_mm / reach_mm) ** 2 + 1e-2)
    u, v = np.moveaxis((points_mm[index, :2] - at_mm[:, None]) / reach_mm[..., None], 2, 0)
    design = quadric_terms(u, v)
    normal = np.einsum("nk,nki,nkj->nij", weight, design, design)
    normal += np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.diag(RIDGE)
    right = np.einsum("nk,nki,nk->ni", weight, design, points_mm[index, 2])
    return np.asarray(np.linalg.solve(normal, right[..., None])[:, 0, 0])
