"""How deep a damage of a side is: normal to the twin, from the skin that was lost."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from geometry.blade.nominal import Nominal
from geometry.damage.local_shape import quadric_terms
from geometry.damage.regions import Field, Region
from geometry.damage.skin import Skin, skin_of
from geometry.deformation.twin import Twin
from geometry.types import Floats, Ints, Measurand, Measured, Mesh, NotMeasured

BORDERING = 1.5  # spacings from lost skin within which its break begins
ON_SKIN = 5.0  # sigmas of a point within which it lies on the twin: of many, none strays farther
LEAST = 6  # neighbours of a place that tell how deep it is
A_PART = 8  # of a region's points lies about its bottom ...
MOST = 60  # ... and no more of them tell it
POINTED = 2.5  # sigmas by which a bottom is deeper among the nearest points
UNTOLD = 0.4  # of the rise over the nearest points: so far a pointed bottom may reach beyond its quadric
OPPOSITE = -0.5  # cosine of normals that look out of the two sides of metal
A_SIDE = 0.1  # of the lost skin that makes it a side of its own: metal that is gone from both is pierced


def normal_depth(region: Region, found: Field, nominal: Nominal, twin: Twin) -> Measured:
    """The largest distance normal to the twin, from the lost skin where metal is missing: below half of the
    metal's thickness the skin of its other side is nearer. Which side was lost too thin a scan may not tell.

    The mean over a neighbourhood tells where the bottom is, and flattens it; how deep it is tells the quadric
    through the points around. Through many of them it averages their noise; where the bottom is pointed it
    would flatten that, too, and the quadric through the nearest ones counts. So near to the skin of the other
    side that noise hides what lies between, it may have pierced the metal.
    """
    height_mm = _heights(region, found, nominal, twin)
    deepest, around = _deepest(height_mm, region, found)
    if len(around) < LEAST:
        return NotMeasured(reason=f"{len(around)} points tell how deep it is")
    if region.missing and not len(region.lost) and _midway(around, height_mm, found, twin):
        return NotMeasured(reason="the scan is too thin to tell from which side metal is missing")
    wider = _wider(around, deepest, region.points[np.isfinite(height_mm[region.points])], found)
    at_mm = found.scan_mm[wider] - found.scan_mm[deepest]
    at_mm = at_mm @ np.linalg.eigh(at_mm.T @ at_mm)[1][:, :0:-1]
    depth_mm, near = np.abs(height_mm[wider]), np.arange(len(around))
    wide, narrow = _bottom(at_mm, depth_mm, near), _bottom(at_mm[near], depth_mm[near], near)
    more_mm = narrow.depth_mm - wide.depth_mm
    pointed = more_mm > POINTED * narrow.noise_mm
    bottom = narrow if pointed else wide
    left_mm = float(np.median(np.abs(found.height_mm[around])))
    pierced = left_mm < min(2.0 * ON_SKIN * found.noise_mm, 0.5 * bottom.depth_mm)
    unsure_mm = [bottom.noise_mm, UNTOLD * narrow.rise_mm, more_mm * pointed, 0.5 * left_mm * pierced]
    sigma_mm = float(np.linalg.norm([found.sigma_mm[deepest], *unsure_mm]))
    return Measurand(name="depth", value=bottom.depth_mm, sigma=sigma_mm, unit="mm")


def _deepest(height_mm: Floats, region: Region, found: Field) -> tuple[int, Ints]:
    """The point of the region whose neighbourhood is deepest in the mean, and that neighbourhood."""
    near = found.neighbours[region.points]
    of_it = (near >= 0) & np.isfinite(height_mm[near])
    mean_mm = np.ma.masked_array(height_mm[near], ~of_it).mean(axis=1).filled(0.0)
    place = int(np.argmax(np.abs(mean_mm) * (of_it.sum(axis=1) >= LEAST)))
    return int(region.points[place]), near[place][of_it[place]]


def _midway(around: Ints, height_mm: Floats, found: Field, twin: Twin) -> bool:
    """Whether of points next to each other some are nearer to one side of the metal, some to the other."""
    points_mm, depth_mm = found.scan_mm[around], np.abs(height_mm[around])
    skin = skin_of(twin.mesh)
    normals = skin.normals[skin.closest(points_mm)[2]]
    apart_mm = np.linalg.norm(points_mm[:, None] - points_mm, axis=2)
    next_to = apart_mm < 0.5 * (depth_mm[:, None] + depth_mm)
    return bool((next_to & (normals @ normals.T < OPPOSITE)).any())


def _wider(around: Ints, deepest: int, points: Ints, found: Field) -> Ints:
    """The points `around` the deepest one, and the next of the region's: a small part of it, not too many."""
    count = int(np.clip(len(points) // A_PART, len(around), MOST))
    others = points[~np.isin(points, around)]
    apart_mm = np.linalg.norm(found.scan_mm[others] - found.scan_mm[deepest], axis=1)
    return np.concatenate([around, others[np.argsort(apart_mm)[: count - len(around)]]])


def _heights(region: Region, found: Field, nominal: Nominal, twin: Twin) -> Floats:
    """Signed distances (n,) of the scan points to the twin, those of a break to the skin that it has lost.

    Where both sides are gone that is the farther one: a hole is as deep as the metal is thick. Of sound skin
    under lost skin, on the other side of the metal, there is none: NaN.
    """
    if not (region.missing and len(region.lost)):
        return found.height_mm
    height_mm = found.height_mm.copy()
    about = np.unique(found.neighbours[region.points])
    about = about[about >= 0]
    points_mm, clear_mm = found.scan_mm[about], ON_SKIN * found.noise_mm
    inside = np.isin(about, region.points)
    broken = inside & (np.abs(found.height_mm[about]) > clear_mm)
    face, sample = _faces_over(region.lost, found, twin)
    for side in _sides(region.lost, nominal):
        own = face[np.isin(sample, side)]
        if not len(own):
            continue
        skin = Skin(Mesh(vertices_mm=twin.mesh.vertices_mm, faces=twin.mesh.faces[own]))
        apart_mm, feet_mm, foot = skin.closest(points_mm)
        if np.abs(apart_mm[inside]).min() <= BORDERING * found.spacing_mm:  # else it was not seen
            inward_mm = ((points_mm - feet_mm) * skin.normals[foot]).sum(axis=1)
            height_mm[about[broken]] = np.minimum(height_mm[about], inward_mm)[broken]
            height_mm[about[~broken & (inward_mm < -clear_mm)]] = np.nan
    return height_mm


def _sides(lost: Ints, nominal: Nominal) -> list[Ints]:
    """The lost samples, those apart that look opposite ways, a few of them left out."""
    normals, area_mm2 = nominal.samples.normals[lost], nominal.samples.area_mm2[lost]
    axis = np.linalg.eigh((normals * area_mm2[:, None]).T @ normals)[1][:, -1]
    above = normals @ axis > 0.0
    return [lost[side] for side in (above, ~above) if area_mm2[side].sum() > A_SIDE * area_mm2.sum()]


def _faces_over(lost: Ints, found: Field, twin: Twin) -> tuple[Ints, Ints]:
    """The faces of the twin about the lost samples, and the sample that is nearest to each."""
    low_mm, high_mm = found.skin_mm[lost].min(axis=0), found.skin_mm[lost].max(axis=0)
    middle_mm = twin.mesh.vertices_mm[twin.mesh.faces].mean(axis=1)
    boxed = np.flatnonzero(((middle_mm >= low_mm - 1.0) & (middle_mm <= high_mm + 1.0)).all(axis=1))
    return boxed, np.asarray(cKDTree(found.skin_mm).query(middle_mm[boxed])[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class _Bottom:
    """What a quadric tells of a bottom: its depth, what noise leaves in it, how far it rises from there."""

    depth_mm: float
    noise_mm: float
    rise_mm: float


def _bottom(at_mm: Floats, depth_mm: Floats, where: Ints) -> _Bottom:
    """The deepest of the places `where` on the full quadric through points (n, 2) with depths (n,)."""
    terms = quadric_terms(*at_mm.T)
    inverse = np.linalg.pinv(terms, rcond=1e-6)
    fitted_mm = terms @ (inverse @ depth_mm)
    free = max(len(depth_mm) - terms.shape[1], 1)
    scatter_mm = float(np.linalg.norm(depth_mm - fitted_mm) / np.sqrt(free))
    deepest = int(where[np.argmax(fitted_mm[where])])
    return _Bottom(
        depth_mm=float(fitted_mm[deepest]),
        noise_mm=scatter_mm * float(np.linalg.norm(terms[deepest] @ inverse)),
        rise_mm=float(fitted_mm[deepest] - fitted_mm[where].min()),
    )
