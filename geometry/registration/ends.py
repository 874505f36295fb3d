"""Where the surface of a blade stops: the rims of its nominal, and the ends of a scan that stops there."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial import cKDTree
from scipy.special import log_ndtr, ndtr

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
BLURS_MM = np.geomspace(5e-4, 0.4, 14)  # of an end ...
SHARPEST = 0.5  # of the scatter of the wall's points: what pushes them off it blurs its end, too ...
BLUNTEST_MM = 0.08  # ... beyond which it is ragged ...
DOUBT = 1.0  # ... if that is clearly likelier: by so much, in logarithms
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
    walls = [_wall(rim, moved_mm, sound, found, nominal) for rim in rims(nominal)]
    both = [wall for wall in walls if wall is not None]
    if len(both) < 2:
        return ()
    ends = _stops(both)
    chance_mm = CHANCE * float(np.hypot(ends[0].sigma_mm, ends[1].sigma_mm))
    return ends if abs(ends[0].off_mm - ends[1].off_mm) <= chance_mm else ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Wall:
    """The wall of a scan next to an end, and where it may stop: `stops_mm` (b,) are the likeliest places for
    each blur of `BLURS_MM`, `misfits` (b,) how unlikely they are.
    """

    points: int
    middle_mm: Floats  # (3,)
    height_mm: float
    outward: float
    scatter_mm: float
    stops_mm: Floats
    misfits: Floats

    def end(self, shares: Floats) -> End:
        """Its end, if the blurs have these shares (b,)."""
        stop_mm = float(shares @ self.stops_mm)
        each_mm = (WINDOW_MM + stop_mm) / self.points
        blur_mm = max(float(shares @ BLURS_MM), self.scatter_mm)
        unsure_mm2 = float(shares @ (self.stops_mm - stop_mm) ** 2)
        return End(
            point_mm=np.array([*self.middle_mm[:2], self.height_mm + self.outward * stop_mm]),
            height_mm=self.height_mm,
            sigma_mm=float(np.sqrt((3.0 * blur_mm + 2.0 * each_mm) * each_mm + unsure_mm2)),
        )


def _wall(rim: Rim, moved_mm: Floats, sound: Bools, found: Closest, nominal: Nominal) -> _Wall | None:
    """The wall next to a rim, if it stops there sharply and no face beyond is seen."""
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
    stops_mm, misfits = _likeliest(past_mm[wall])
    scatter_mm = robust_sigma(found.distance_mm[wall])
    misfits[min(SHARPEST * scatter_mm, BLURS_MM[-1]) > BLURS_MM] = np.inf
    if misfits[BLURS_MM < BLUNTEST_MM].min() > misfits.min() + DOUBT:
        return None
    return _Wall(
        points=len(wall),
        middle_mm=moved_mm[wall].mean(axis=0),
        height_mm=height_mm,
        outward=outward,
        scatter_mm=scatter_mm,
        stops_mm=stops_mm,
        misfits=misfits,
    )


def _stops(walls: list[_Wall]) -> tuple[End, ...]:
    """Where walls stop. One scanner blurs them alike, and each blur counts by how likely it makes all: the
    likeliest one alone would go to and fro between two as soon as the scan moves.
    """
    misfits = np.sum([wall.misfits for wall in walls], axis=0)
    shares = np.exp(misfits.min() - misfits)
    return tuple(wall.end(shares / shares.sum()) for wall in walls)


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


def _likeliest(past_mm: Floats) -> tuple[Floats, Floats]:
    """Where points (n,), even up to there and blurred by normal noise, stop: the likeliest place for each
    blur (b,), and its misfit: minus the logarithm of how likely."""
    count, farthest_mm = len(past_mm), 0.8 * WINDOW_MM

    def misfit(stop_mm: float, blur_mm: float) -> float:
        inside = log_ndtr((stop_mm - past_mm) / blur_mm).sum()
        to, of = _ramp((stop_mm + WINDOW_MM) / blur_mm), _ramp((stop_mm - WINDOW_MM) / blur_mm)
        return count * float(np.log(blur_mm * (to - of))) - float(inside)

    limits, precise = (-farthest_mm, farthest_mm), {"xatol": 1e-5}
    best = [minimize_scalar(misfit, args=(blur,), bounds=limits, options=precise) for blur in BLURS_MM]
    return np.array([one.x for one in best]), np.array([one.fun for one in best])


def _ramp(u: float) -> float:
    """The integral of the normal distribution up to u."""
    return float(u * ndtr(u) + np.exp(-0.5 * u * u) / np.sqrt(2.0 * np.pi))
