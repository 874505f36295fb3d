"""Where the surface of a blade stops: the rims of its nominal, and the ends of a scan that stops there."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree
from scipy.special import log_ndtr

from geometry.blade.nominal import UP, Closest, Nominal
from geometry.robust import robust_sigma
from geometry.types import Bools, Floats, Ints

RIM_STEP_MM = 0.05
RIM_MM = 0.1  # from a rim: there a foot may be on either face, whichever noise pushed its point to
WINDOW_MM = 1.0  # of the wall's points on both sides of an end
CLEAR_MM = 1.0  # from damage
LEAST = 100  # points in the window
LIT = 5  # points on a face beyond a rim that make it seen ...
INWARD_MM = 0.3  # ... so far from it: nearer to it lie feet of a wall that slid past its end, too
SHARE = 0.05  # of the points that a tip face would have, below which it is not seen
SHARPEST_MM, BLUNTEST_MM = 5e-4, 0.08  # blur of an end; beyond, it is ragged
BLURS_MM = (0.002, 0.01, 0.04)  # to start from: the likelihood has a ridge
LEVEL_MM = 0.01  # of a rim that is an end at one height
CHANCE = 4.0  # sigmas within which two ends are as far apart as the nominal's


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rim:
    """The sharp edge round an end face: points (m, 3) along it, and the heights between which it lies."""

    points_mm: Floats
    low_mm: float
    high_mm: float
    tree: cKDTree


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class End:
    """Where the wall of a scan stops: the middle of that edge (3,), and the nominal height it belongs to."""

    point_mm: Floats
    height_mm: float
    sigma_mm: float

    @property
    def off_mm(self) -> float:
        return float(self.point_mm[2]) - self.height_mm


@lru_cache(maxsize=4)
def rims(nominal: Nominal) -> tuple[Rim, ...]:
    """The rims of bottom and tip, as far as the nominal has them: a rounded tip has none."""
    found = (_rim(nominal, lid) for lid in (nominal.end_face, nominal.tip_face))
    return tuple(rim for rim in found if rim is not None)


def _rim(nominal: Nominal, lid: Bools) -> Rim | None:
    faces, vertices_mm = nominal.mesh.faces, nominal.mesh.vertices_mm
    edges = np.sort(np.concatenate([faces[lid][:, pair] for pair in ([0, 1], [1, 2], [2, 0])]), axis=1)
    edges, uses = np.unique(edges, axis=0, return_counts=True)
    walls = faces[~lid & _steep(nominal)]
    edges = edges[(uses == 1) & np.isin(edges, walls).all(axis=1)]
    if len(edges) == 0:
        return None
    a_mm, b_mm = vertices_mm[edges[:, 0]], vertices_mm[edges[:, 1]]
    pieces = np.maximum(1, np.ceil(np.linalg.norm(b_mm - a_mm, axis=1) / RIM_STEP_MM)).astype(np.int64)
    edge = np.repeat(np.arange(len(edges)), pieces)
    first = np.concatenate([[0], np.cumsum(pieces)[:-1]])
    part = ((np.arange(len(edge)) - first[edge] + 0.5) / pieces[edge])[:, None]
    points_mm = a_mm[edge] + part * (b_mm - a_mm)[edge]
    low_mm, high_mm = float(points_mm[:, 2].min()), float(points_mm[:, 2].max())
    return Rim(points_mm=points_mm, low_mm=low_mm, high_mm=high_mm, tree=cKDTree(points_mm))


def _steep(nominal: Nominal) -> Bools:
    a, b, c = np.moveaxis(nominal.mesh.vertices_mm[nominal.mesh.faces], 1, 0)
    normal = np.cross(b - a, c - a)
    return np.asarray(np.abs(normal[:, 2]) < UP * np.linalg.norm(normal, axis=1))


def on_rim(nominal: Nominal, points_mm: Floats, reach_mm: float = RIM_MM) -> Bools:
    """Which points (n, 3) of the nominal's surface lie within `reach_mm` of a rim."""
    close = np.zeros(len(points_mm), bool)
    for rim in rims(nominal):
        z_mm = points_mm[:, 2]
        near = np.flatnonzero((z_mm >= rim.low_mm - reach_mm) & (z_mm <= rim.high_mm + reach_mm))
        apart_mm, _ = rim.tree.query(points_mm[near], distance_upper_bound=reach_mm)
        close[near[np.isfinite(apart_mm)]] = True
    return close


def scan_ends(moved_mm: Floats, sound: Bools, found: Closest, nominal: Nominal) -> tuple[End, ...]:
    """Both ends of a scan's wall, where it stops sharply at the rims of the nominal; else none.

    `moved_mm` (n, 3) are the scan's points at about the right pose, `found` their feet. A scan may stop
    anywhere, and one edge near a rim may be chance: ends count only together, unseen faces beyond both,
    as far apart as the rims are.
    """
    ends = [_end(rim, moved_mm, sound, found, nominal) for rim in rims(nominal)]
    both = tuple(end for end in ends if end is not None)
    if len(both) < 2:
        return ()
    chance_mm = CHANCE * float(np.hypot(both[0].sigma_mm, both[1].sigma_mm))
    return both if abs(both[0].off_mm - both[1].off_mm) <= chance_mm else ()


def _end(rim: Rim, moved_mm: Floats, sound: Bools, found: Closest, nominal: Nominal) -> End | None:
    if rim.high_mm - rim.low_mm > LEVEL_MM:
        return None
    height_mm = 0.5 * (rim.low_mm + rim.high_mm)
    outward = 1.0 if height_mm > nominal.pivot_mm[2] else -1.0
    past_mm = outward * (moved_mm[:, 2] - height_mm)
    near = np.flatnonzero(np.abs(past_mm) < WINDOW_MM)
    wall = near[sound[near]]
    if not sound[near].all():
        apart_mm, _ = cKDTree(moved_mm[near[~sound[near]]]).query(moved_mm[wall])
        wall = wall[apart_mm > CLEAR_MM]
    if len(wall) < LEAST or _seen(wall, found, nominal) >= LIT:
        return None
    stop_mm, blur_mm = _step(past_mm[wall])
    if not blur_mm < BLUNTEST_MM:
        return None
    each_mm = (WINDOW_MM + stop_mm) / len(wall)
    blur_mm = max(blur_mm, robust_sigma(found.distance_mm[wall]))
    sigma_mm = float(np.sqrt((3.0 * blur_mm + 2.0 * each_mm) * each_mm))
    middle_mm = moved_mm[wall].mean(axis=0)
    point_mm = np.array([middle_mm[0], middle_mm[1], height_mm + outward * stop_mm])
    return End(point_mm=point_mm, height_mm=height_mm, sigma_mm=sigma_mm)


def without_strays(sound: Bools, clear: Bools, found: Closest, nominal: Nominal) -> Bools:
    """The sound points (n,) less those on a tip face where only a few of them are clear of damage, fewer than
    any seen face would have: what a break leaves near it by chance would hold the height of all.
    """
    lid = sound & nominal.tip_face[found.face] & ~on_rim(nominal, found.points_mm)
    expected = float(np.count_nonzero(sound)) * float(nominal.samples.tip_face.mean())
    seen = np.count_nonzero(lid & clear) >= max(LIT, SHARE * expected)
    return sound if seen else np.asarray(sound & ~lid)


def _seen(near: Ints, found: Closest, nominal: Nominal) -> int:
    """How many of the points near an end lie well inside the face beyond its rim."""
    face, feet_mm = found.face[near], found.points_mm[near]
    lid = nominal.tip_face[face] | nominal.end_face[face]
    return int(np.count_nonzero(~on_rim(nominal, feet_mm[lid], INWARD_MM)))


def _step(past_mm: Floats) -> tuple[float, float]:
    """Where points (n,), even up to there and blurred by normal noise, stop; and the blur: likeliest both."""
    count = len(past_mm)

    def misfit(guess: Floats) -> float:
        stop_mm, blur_mm = float(guess[0]), float(np.exp(guess[1]))
        if not (abs(stop_mm) < 0.8 * WINDOW_MM and SHARPEST_MM <= blur_mm <= WINDOW_MM):
            return np.inf
        return count * float(np.log(WINDOW_MM + stop_mm)) - float(
            log_ndtr((stop_mm - past_mm) / blur_mm).sum()
        )

    start_mm = min(float(np.quantile(past_mm, 0.99)), 0.5)
    limits = {"xatol": 1e-5, "fatol": 1e-4, "maxiter": 200}
    tries = [
        minimize(misfit, np.array([start_mm, np.log(blur_mm)]), method="Nelder-Mead", options=limits)
        for blur_mm in BLURS_MM
    ]
    best = min(tries, key=lambda one: float(one.fun))
    return float(best.x[0]), float(np.exp(best.x[1]))
