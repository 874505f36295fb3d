"""Bent metal: what is missing on one side of it and in excess on the other is one damage."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from geometry.blade.nominal import Nominal
from geometry.damage.depth import region_sigma_mm
from geometry.damage.local_shape import frames_along
from geometry.damage.regions import NONE, Field, Region
from geometry.registration.alignment import Alignment, variance_along
from geometry.types import Bools, Floats, Ints, Measurand

FAINT = 3.0  # sigmas of a mean by which the other side of bent metal stands off at least
AWAY = -0.3  # cosine between normals of the two sides of metal, at most
WRAPPED = 0.1  # mean normal of a region, at most, that lies all round its metal: nothing is behind it
FARTHEST = 5  # points on bent metal that tell how far it is bent
SLOPE = 30  # points about the farthest one that tell how much more it is beyond them


@dataclass(frozen=True, slots=True, kw_only=True)
class BendSettings:
    """When a missing and an excess region are the two sides of bent metal."""

    alike: float = 0.35  # least ratio of their sizes
    behind: float = 0.6  # least share of the skin of the one that looks away from the other
    beside_mm: float = 6.0  # how near they lie: about the thickness of an airfoil


def bent_pairs(
    regions: list[Region], found: Field, nominal: Nominal, settings: BendSettings
) -> tuple[list[tuple[Region, Region]], list[Region]]:
    """Pairs of a missing and an excess region that are the two sides of bent metal, and the regions left."""
    free = list(regions)
    pairs = []
    for missing in [region for region in regions if region.missing]:
        mates = [
            region
            for region in free
            if not region.missing and _two_sides(missing, region, found, nominal, settings)
        ]
        if mates:
            pairs.append((missing, mates[0]))
            free.remove(missing)
            free.remove(mates[0])
    claimed = np.zeros(len(found.scan_mm), bool)
    claimed[np.concatenate([NONE, *(region.points for region in regions)])] = True
    for region in list(free):
        faint = _faint_side(region, claimed, found, nominal, settings)
        missing, excess = (region, faint) if region.missing else (faint, region)
        if len(faint.points) and _two_sides(missing, excess, found, nominal, settings):
            pairs.append((missing, excess))
            free.remove(region)
    return pairs, free


def _faint_side(
    region: Region, claimed: Bools, found: Field, nominal: Nominal, settings: BendSettings
) -> Region:
    """The points behind a region, on the other side of its metal, that stand off the other way, too little to
    make a region of their own: metal that is bent a little."""
    sign = 1.0 if region.missing else -1.0
    own_mm, normals = found.scan_mm[region.points], _skin_normals(region.points, found, nominal)
    way = normals.mean(axis=0)
    if np.linalg.norm(way) < WRAPPED:
        return Region(points=NONE, lost=NONE, missing=not region.missing)
    out = way / np.linalg.norm(way)
    across = frames_along(out[None])[0, :2].T
    off = np.flatnonzero(found.on_airfoil & ~claimed & (sign * found.smooth_mm > FAINT * found.sigma_mm))
    off = off[_skin_normals(off, found, nominal) @ out < AWAY]
    reach_mm = 2.0 * found.spacing_mm
    beside_mm, near = cKDTree(own_mm @ across).query(
        found.scan_mm[off] @ across, distance_upper_bound=reach_mm
    )
    behind = off[np.isfinite(beside_mm)]
    over = region.points[near[np.isfinite(beside_mm)]]
    thick_mm = np.abs((found.scan_mm[behind] - found.scan_mm[over]) @ out)
    return Region(points=behind[thick_mm <= settings.beside_mm], lost=NONE, missing=not region.missing)


def _skin_normals(points: Ints, found: Field, nominal: Nominal) -> Floats:
    """Normals (n, 3) of the nominal's skin that is nearest to scan points."""
    return nominal.samples.normals[cKDTree(found.skin_mm).query(found.scan_mm[points])[1]]


def _two_sides(
    missing: Region, excess: Region, found: Field, nominal: Nominal, settings: BendSettings
) -> bool:
    """Whether two regions are the two sides of bent metal: near each other, as large, as far off, and the one
    looks away from the other.

    A break has lost skin on both sides of the metal, or on the side of its own burr. Metal bent by more than
    its thickness shows no more than half of that as missing.
    """
    sizes = [float(len(region.points)) for region in (missing, excess)]
    gone_mm, over_mm = (float(np.abs(found.smooth_mm[region.points]).max()) for region in (missing, excess))
    if min(sizes) < settings.alike * max(sizes) or over_mm < settings.alike * gone_mm:
        return False
    if not len(missing.lost) and gone_mm < settings.alike * over_mm:
        return False
    nearest_mm, _ = cKDTree(found.scan_mm[excess.points]).query(found.scan_mm[missing.points])
    if np.median(nearest_mm) > settings.beside_mm:
        return False
    return _share_behind(missing, excess, found, nominal) >= settings.behind


def _share_behind(missing: Region, excess: Region, found: Field, nominal: Nominal) -> float:
    """The share of the skin over missing metal that looks away from the skin under the excess."""
    samples, tree = nominal.samples, cKDTree(found.skin_mm)
    over = missing.lost if len(missing.lost) else np.asarray(tree.query(found.scan_mm[missing.points])[1])
    way = _skin_normals(excess.points, found, nominal).mean(axis=0)
    away = samples.normals[over] @ way < AWAY * np.linalg.norm(way)
    return float(samples.area_mm2[over][away].sum() / samples.area_mm2[over].sum())


def bend_depth(region: Region, found: Field) -> Measurand:
    """How far bent metal lies off the twin: the median of its farthest points.

    A corner is bent most at its end, where a surface through the points around would fall short of it.
    """
    depth = _farthest("depth", found.height_mm[region.points], region, found)
    return replace(depth, sigma=float(np.hypot(depth.sigma, region_sigma_mm(region, found))))


def bend_off_nominal(region: Region, found: Field, nominal: Nominal, alignment: Alignment) -> Measurand:
    """How far bent metal lies off the nominal, its sigma with the pose's.

    Where a bend begins is a matter of taste, for the twin follows a gentle one a part of its way: what limits
    of form are about is both together.
    """
    foot = nominal.closest(found.scan_mm[region.points])
    off = _farthest("off_nominal", foot.distance_mm, region, found)
    worst = int(np.argmax(np.abs(foot.distance_mm)))
    pose_mm2 = variance_along(alignment, foot.points_mm[worst], foot.normals[worst])
    return replace(off, sigma=float(np.sqrt(off.sigma**2 + pose_mm2)))


def _farthest(name: str, distance_mm: Floats, region: Region, found: Field) -> Measurand:
    """The median distance of the region's farthest points; the metal ends up to a spacing beyond them."""
    off_mm = np.abs(distance_mm)
    order = np.argsort(off_mm)
    value_mm = float(np.median(off_mm[order[-FARTHEST:]]))
    points_mm = found.scan_mm[region.points]
    near = cKDTree(points_mm).query(points_mm[order[-1]], min(SLOPE, len(points_mm)))[1]
    apart_mm = np.column_stack([points_mm[near] - points_mm[order[-1]], np.ones(len(near))])
    slope = np.linalg.lstsq(apart_mm, off_mm[near], rcond=0.1)[0][:3]
    end_mm = float(np.linalg.norm(slope)) * found.spacing_mm
    sigma_mm = np.linalg.norm([found.noise_mm, off_mm[order[-1]] - value_mm, end_mm])
    return Measurand(name=name, value=value_mm, sigma=float(sigma_mm), unit="mm")
