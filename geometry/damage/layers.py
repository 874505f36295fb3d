"""A scan in layers: skin that counts as lost, or as covered, and was scanned all the same.

Over missing metal a scanner sees no skin, and none beneath metal in excess. Where it shows both, the part
moved between two views, or they were merged wrongly.
"""

import numpy as np
from scipy.spatial import cKDTree

from geometry.blade.nominal import Nominal
from geometry.damage.regions import DEEP, Field, Region
from geometry.damage.skin import Skin
from geometry.types import Bools, Floats

REACH = 2.0  # spacings of the points, round the foot of one, in which the skin is looked for
ENOUGH = 3  # points of the skin there
ONE_SIDED = 0.6  # length of the mean direction to them: beside the border of a break it is 2 / pi
BARE = 0.2  # of the area of a damage's points: so much skin that nothing covers is gone
MOST = 0.6  # of a damage's points; breaks straight through the metal have up to 0.41, scans in layers 0.63 on
SAMPLE = 2000  # points of a region that are asked


def in_layers(region: Region, found: Field, nominal: Nominal, skin: Skin) -> bool:
    """Whether the scan shows the skin, all round, at the feet of most of the points of a damage.

    The bottom of a pit that goes nearly through has its feet on the far side, but leaves bare skin above.
    """
    bare_mm2 = float(nominal.samples.area_mm2[region.lost].sum())
    if bare_mm2 > BARE * len(region.points) * found.spacing_mm**2:
        return False
    asked = region.points[:: -(-len(region.points) // SAMPLE)]
    feet_mm = skin.closest(found.scan_mm[asked])[1]
    reach_mm = REACH * found.local_mm[asked]
    sound = _sound(region, found, feet_mm, float(reach_mm.max()))
    sound_mm, height_mm = found.scan_mm[sound], found.height_mm[sound]
    apart_mm = DEEP * np.sqrt(2.0) * found.noise_mm
    near = cKDTree(sound_mm).query_ball_point(feet_mm, reach_mm)
    shown = [
        _surrounded(foot_mm, sound_mm[there][np.abs(height_mm[there] - own_mm) > apart_mm])
        for foot_mm, own_mm, there in zip(feet_mm, found.height_mm[asked], near, strict=True)
    ]
    return float(np.mean(shown)) > MOST


def _sound(region: Region, found: Field, feet_mm: Floats, reach_mm: float) -> Bools:
    """Which points (n,) lie on the skin near a damage and are not of it."""
    low_mm, high_mm = feet_mm.min(axis=0) - reach_mm, feet_mm.max(axis=0) + reach_mm
    sound = ~found.off_skin & ((found.scan_mm >= low_mm) & (found.scan_mm <= high_mm)).all(axis=1)
    sound[region.points] = False
    return np.asarray(sound)


def _surrounded(foot_mm: Floats, points_mm: Floats) -> bool:
    """Whether there are enough points about a foot, and not on one side only."""
    if len(points_mm) < ENOUGH:
        return False
    way_mm = points_mm - foot_mm
    mean = (way_mm / np.maximum(np.linalg.norm(way_mm, axis=1, keepdims=True), 1e-9)).mean(axis=0)
    return bool(np.linalg.norm(mean) < ONE_SIDED)
