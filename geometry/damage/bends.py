"""Bent metal: what is missing on one side of it and in excess on the other is one damage."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from geometry.blade.nominal import Nominal
from geometry.damage.depth import region_sigma_mm
from geometry.damage.regions import Field, Region
from geometry.types import Measurand

FARTHEST = 5  # points on bent metal that tell how far it is bent


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
    return pairs, free


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
    under = np.asarray(tree.query(found.scan_mm[excess.points])[1])
    over = missing.lost if len(missing.lost) else np.asarray(tree.query(found.scan_mm[missing.points])[1])
    way = samples.normals[under].mean(axis=0)
    away = samples.normals[over] @ way < -0.3 * np.linalg.norm(way)
    return float(samples.area_mm2[over][away].sum() / samples.area_mm2[over].sum())


def bend_depth(region: Region, found: Field) -> Measurand:
    """How far bent metal lies off the twin: the median of its farthest points.

    A corner is bent most at its end, where a surface through the points around would fall short of it.
    """
    off_mm = np.sort(np.abs(found.height_mm[region.points]))
    value_mm = float(np.median(off_mm[-FARTHEST:]))
    sigma_mm = np.linalg.norm([region_sigma_mm(region, found), found.noise_mm, off_mm[-1] - value_mm])
    return Measurand(name="depth", value=value_mm, sigma=float(sigma_mm), unit="mm")
