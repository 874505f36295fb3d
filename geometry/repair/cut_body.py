"""The body that cuts the lost metal out of the twin: an implicit surface through the points of a break."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from geometry.damage.broken import BrokenSurface
from geometry.damage.skin import Skin
from geometry.errors import CannotRepair
from geometry.kernels.implicit import WIDENING, blend_quadrics, nearest_points
from geometry.types import Bools, Floats, Mesh

FAR = 1e3  # field value of a node whose side is known but whose distance is not
CONTRADICTING = 0.02  # share of the votes on a side that may be wrong before the surface counts as open
COVER = 2.0  # spacings about a point of sound skin in which no metal is lost
COLLAR = 3  # nodes that the cut body reaches past the skin


OPEN = "the broken surface is open: scan points do not part lost metal from sound"


@dataclass(frozen=True, slots=True, kw_only=True)
class Reach:
    """How far the broken surface is continued about scan points, those of the sound rim among them, and how
    far at most about its own."""

    known_mm: float
    break_mm: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Grid:
    origin_mm: Floats  # (3,)
    step_mm: float
    shape: tuple[int, int, int]


def cut_body(
    broken: BrokenSurface, skin: Skin, reach: Reach, slack_mm: float, resolution: float, max_nodes: int
) -> Mesh:
    """The closed surface around the lost metal: the broken surface, then well outside the twin.

    `resolution`: grid cells across the square root of the broken area. The box grows until the lost metal
    ends inside it. Raises `CannotRepair` if the broken surface, continued so far about its points, does not
    close the lost metal off.
    """
    step_mm = float(np.sqrt(broken.area_mm2)) / resolution
    margin_mm = (COLLAR + 2) * step_mm
    low, high = broken.raw_mm.min(axis=0) - margin_mm, broken.raw_mm.max(axis=0) + margin_mm
    while True:
        shape = np.ceil((high - low) / step_mm).astype(int) + 1
        if float(np.prod(shape, dtype=float)) > max_nodes:
            raise CannotRepair(OPEN)
        grid = _Grid(origin_mm=low, step_mm=step_mm, shape=(int(shape[0]), int(shape[1]), int(shape[2])))
        field, lost = _lost_field(grid, broken, skin, reach, slack_mm)
        grow_low = np.array([lost.take(0, axis).any() for axis in range(3)])
        grow_high = np.array([lost.take(-1, axis).any() for axis in range(3)])
        if not (grow_low.any() or grow_high.any()):
            return _zero_surface(field, grid)
        more_mm = 0.3 * (high - low)
        low, high = low - grow_low * more_mm, high + grow_high * more_mm


def _lost_field(
    grid: _Grid, broken: BrokenSurface, skin: Skin, reach: Reach, slack_mm: float
) -> tuple[Floats, Bools]:
    """A field that is positive where metal is lost and just outside it; and the lost nodes in the twin."""
    around_mm, beyond_mm = reach.known_mm + 2.0 * grid.step_mm, reach.break_mm + 2.0 * grid.step_mm
    place = grid.shape, grid.origin_mm, grid.step_mm
    to_break_mm = nearest_points(*place, broken.points_mm, beyond_mm)
    to_rim_mm = nearest_points(*place, broken.rim.feet_mm, around_mm)
    band = (to_break_mm <= around_mm) | (np.isfinite(to_break_mm) & np.isfinite(to_rim_mm))
    field = blend_quadrics(
        np.where(band, to_break_mm, np.inf),
        grid.origin_mm,
        grid.step_mm,
        broken.points_mm,
        broken.frames,
        broken.bending,
        1.2 * broken.spacing_mm,
        beyond_mm,
        WIDENING,
    )
    inside = skin.nodes_inside(grid.origin_mm, grid.step_mm, grid.shape)
    _end_at_rim(field, to_break_mm, inside & band, grid, broken, slack_mm)
    lost = lost_beyond_band(inside & ~band, inside & band, field) | (inside & band & (field > 0.0))
    beyond = ndimage.binary_dilation(lost, np.ones((3, 3, 3), bool), COLLAR)
    return np.where(band, field, np.where(lost | (beyond & ~inside), FAR, -FAR)), lost


def _end_at_rim(
    field: Floats, nearest_mm: Floats, band: Bools, grid: _Grid, broken: BrokenSurface, slack_mm: float
) -> None:
    """End the loss, in `field`, where sound skin was seen, and nearer than the break.

    Beyond its rim the break is continued only to be cut by the twin. Where it runs out flat, or is rough,
    the two cross anywhere. Next to a point of sound skin no metal is lost, unless the break is as near but
    for the holes between its points: `slack_mm`.
    """
    if not len(broken.rim.points_mm):
        return
    spacing_mm = float(np.median(broken.spacing_mm))
    margin_mm = max(1.5 * spacing_mm, slack_mm)
    at = np.nonzero(band & (field > 0.0) & (nearest_mm > margin_mm))
    node_mm = grid.origin_mm + grid.step_mm * np.column_stack(at)
    to_rim_mm = cKDTree(broken.rim.feet_mm).query(node_mm)[0]
    covered_mm = np.maximum(margin_mm + to_rim_mm - nearest_mm[at], to_rim_mm - COVER * spacing_mm)
    field[at] = np.minimum(field[at], covered_mm)


def lost_beyond_band(free: Bools, band: Bools, field: Floats) -> Bools:
    """The free nodes in the twin, out of reach of the broken surface, that lie on its outer side.

    Each connected region takes the side of the band nodes at its border, each of which has as much to say as
    it lies off the broken surface. Raises `CannotRepair` if they contradict each other: then there is a hole
    in the band.
    """
    region, count = ndimage.label(free)
    votes = np.zeros((count + 1, 2))
    for axis in range(3):
        for a, b in ((slice(1, None), slice(None, -1)), (slice(None, -1), slice(1, None))):
            here = tuple(a if i == axis else slice(None) for i in range(3))
            there = tuple(b if i == axis else slice(None) for i in range(3))
            meet = (region[here] > 0) & band[there]
            side_mm = field[there][meet]
            np.add.at(votes, (region[here][meet], (side_mm > 0.0).astype(int)), np.abs(side_mm))
    lost = votes[:, 1] > votes[:, 0]
    contradicting = votes[1:].min(axis=1).sum()
    if not contradicting <= CONTRADICTING * votes.sum():
        raise CannotRepair(OPEN)
    return np.asarray(lost[region] & free)


def _zero_surface(field: Floats, grid: _Grid) -> Mesh:
    """The closed surface where the field is zero, its normals pointing to negative values."""
    field = np.clip(field, -2.0 * grid.step_mm, 2.0 * grid.step_mm)
    if not (field > 0.0).any():
        raise CannotRepair("no metal is missing under the broken surface")
    field[field == 0.0] = -1e-9 * grid.step_mm
    padded = np.pad(field, 1, constant_values=-2.0 * grid.step_mm)
    vertices, faces, _, _ = marching_cubes(padded.astype(np.float64), 0.0, gradient_direction="ascent")
    return Mesh(
        vertices_mm=grid.origin_mm + (vertices.astype(np.float64) - 1.0) * grid.step_mm,
        faces=faces.astype(np.int64),
    )
