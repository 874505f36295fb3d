"""How much metal stands out of the skin: between the scan points on it and the twin."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from geometry.damage.broken import bare_skin
from geometry.damage.facing import outward_sign
from geometry.damage.local_shape import gathered, local_quadrics, spacings_mm, thinned, turn_over
from geometry.damage.regions import SKIN_SPACINGS, Field, Region
from geometry.damage.skin import Skin, skin_of
from geometry.deformation.twin import Twin
from geometry.errors import CannotRepair
from geometry.kernels.implicit import WIDENING, blend_quadrics, nearest_points
from geometry.kernels.winding import winding_numbers
from geometry.types import Floats, Measurand, Measured, NotMeasured

NODES = 250_000  # of the grid over the metal, at most
REACH = 3.0  # spacings about a point in which its quadric speaks
CELL_SIGMAS = 6.0  # points this near to each other, in their noise, count as one
BORDER = 0.25  # standard uncertainty of where a bead ends, in spacings of its points
OPEN = 0.1  # from 0 or 1: a winding number so far off both is of a place that nothing closes off


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Surface:
    """Points (n, 3) with their frames, bending and spacings, and those of the skin that they cover."""

    points_mm: Floats
    frames: Floats
    bending: Floats
    spacing_mm: Floats
    skin_mm: Floats
    skin_areas_mm2: Floats  # (k, 3) along the twin's normals

    @property
    def area_mm2(self) -> float:
        return float((self.spacing_mm**2).sum())


def excess_volume(region: Region, found: Field, twin: Twin, max_gap_mm: float) -> Measured:
    """Volume (mm3) of a region of metal in excess: what lies outside the twin and below the region's points.

    Counted on a grid, whose nodes at either surface count in part. The surface is a blend of local quadrics
    near the points; farther off, what it and the covered skin wind round counts. What nothing closes off, for
    the scan has a hole there, is counted by halves and stated as uncertainty; as much as half a ball of the
    permitted gap, and the metal was not seen.
    """
    skin = skin_of(twin.mesh)
    try:
        surface = _surface(region, found, skin)
    except CannotRepair:
        return NotMeasured(reason="metal in excess does not show which way is out")
    volume_mm3, open_mm3 = _between(surface, found.spacing_mm, skin)
    if open_mm3 > np.pi / 12.0 * max_gap_mm**3:
        return NotMeasured(reason="a side of the metal in excess was not seen")
    border_mm = 2.0 * np.sqrt(np.pi * surface.area_mm2)
    sigmas_mm3 = (
        surface.area_mm2 * float(np.median(found.sigma_mm[region.points])),
        BORDER * found.spacing_mm * border_mm * volume_mm3 / surface.area_mm2,
        open_mm3,
    )
    return Measurand(name="volume", value=volume_mm3, sigma=float(np.linalg.norm(sigmas_mm3)), unit="mm3")


def _surface(region: Region, found: Field, skin: Skin) -> _Surface:
    """The surface through a region's points, its normals out of the metal."""
    points_mm = thinned(found.scan_mm[region.points], CELL_SIGMAS * found.noise_mm)
    _, feet_mm, face = skin.closest(points_mm)
    points_mm, frames, bending = local_quadrics(points_mm, points_mm)
    turn_over(frames, bending, outward_sign(points_mm, frames[:, 2], feet_mm, skin.normals[face]) > 0.0)
    skin_mm, skin_areas_mm2 = _covered(region, found, feet_mm, skin)
    return _Surface(
        points_mm=points_mm,
        frames=frames,
        bending=bending,
        spacing_mm=spacings_mm(points_mm),
        skin_mm=skin_mm,
        skin_areas_mm2=skin_areas_mm2,
    )


def _covered(region: Region, found: Field, feet_mm: Floats, skin: Skin) -> tuple[Floats, Floats]:
    """Samples (k, 3) of the skin under a region and their areas along the normal: no other point is near, and
    they hang together with the feet (n, 3) of its own points."""
    pitch_mm = found.spacing_mm
    reach_mm = SKIN_SPACINGS * pitch_mm
    own_mm = np.concatenate([found.scan_mm[region.points], feet_mm])
    low_mm, high_mm = own_mm.min(axis=0) - reach_mm, own_mm.max(axis=0) + reach_mm
    skin_mm, normals = skin.samples(pitch_mm, low_mm, high_mm)
    other = ((found.scan_mm >= low_mm - reach_mm) & (found.scan_mm <= high_mm + reach_mm)).all(axis=1)
    other[region.points] = False
    beside_mm = found.scan_mm[other]
    skin_mm, normals = bare_skin(skin_mm, normals, feet_mm, beside_mm, reach_mm, reach_mm, 2.0 * pitch_mm)
    return skin_mm, pitch_mm**2 * normals


def _between(surface: _Surface, spacing_mm: float, skin: Skin) -> tuple[float, float]:
    """Volume (mm3) between a surface and the skin, and the standard uncertainty that its holes leave."""
    ends_mm = np.concatenate([surface.points_mm, surface.skin_mm])
    reach_mm = REACH * max(float(np.median(surface.spacing_mm)), spacing_mm)
    low_mm, high_mm = ends_mm.min(axis=0) - reach_mm, ends_mm.max(axis=0) + reach_mm
    step_mm = max(0.5 * spacing_mm, float(np.cbrt(np.prod(high_mm - low_mm) / NODES)))
    x, y, z = np.ceil((high_mm - low_mm) / step_mm).astype(int) + 1
    shape = (int(x), int(y), int(z))
    near_mm = nearest_points(shape, low_mm, step_mm, surface.points_mm, reach_mm)
    height_mm = blend_quadrics(
        near_mm,
        low_mm,
        step_mm,
        surface.points_mm,
        surface.frames,
        surface.bending,
        1.2 * surface.spacing_mm,
        reach_mm,
        WIDENING,
    )
    outside = _outside(skin, low_mm, step_mm, shape)
    below = np.clip(0.5 - height_mm / step_mm, 0.0, 1.0)
    free = ~np.isfinite(height_mm) & (outside > 0.0)
    wound = _wound(surface, low_mm + step_mm * np.argwhere(free), reach_mm)
    below[free] = np.where(wound < OPEN, 0.0, np.where(wound > 1.0 - OPEN, 1.0, wound))
    open_ = np.minimum(below[free], 1.0 - below[free]) * outside[free]
    return float((below * outside).sum()) * step_mm**3, float(open_.sum()) * step_mm**3


def _outside(skin: Skin, low_mm: Floats, step_mm: float, shape: tuple[int, int, int]) -> Floats:
    """The share of each node of a grid that lies outside the skin."""
    inside = skin.nodes_inside(low_mm, step_mm, shape)
    outside = np.where(inside, 0.0, 1.0)
    crossed = ndimage.binary_dilation(inside) & ndimage.binary_dilation(~inside)
    distance_mm = skin.closest(low_mm + step_mm * np.argwhere(crossed))[0]
    outside[crossed] = np.clip(0.5 + distance_mm / step_mm, 0.0, 1.0)
    return outside


def _wound(surface: _Surface, places_mm: Floats, cell_mm: float) -> Floats:
    """How far the surface and the covered skin wind round places (n, 3) no nearer to it than `cell_mm`: from
    there the parts of a cell are as good as one."""
    areas_mm2 = surface.frames[:, 2] * surface.spacing_mm[:, None] ** 2
    above_mm = thinned(surface.points_mm, cell_mm)
    above_mm2 = gathered(surface.points_mm, areas_mm2, cell_mm)
    points_mm = np.concatenate([above_mm, surface.skin_mm])
    return winding_numbers(places_mm, points_mm, np.concatenate([above_mm2, -surface.skin_areas_mm2]))
