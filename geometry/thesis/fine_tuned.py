"""Registration after thesis chapter 3: principal axes, ICP, and alignment of what is alike in shape.

The fine-tuned step keeps the pairs of scan and CAD points whose neighbourhoods resemble each other in place
and in Gaussian curvature, and cuts off the rest at the corner of an L-curve.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from geometry.blade.nominal import Nominal
from geometry.errors import BadInput, CannotRegister
from geometry.kernels.hausdorff import average_hausdorff
from geometry.kernels.neighbours import near_each_other
from geometry.registration.alignment import Alignment
from geometry.registration.coarse import principal_frame
from geometry.registration.fit import every, felt, information, solve_step
from geometry.robust import robust_sigma
from geometry.scan.surface import local_shape
from geometry.thesis.cad_points import pitch_of, sample_cad
from geometry.transforms import apply, inverse, rigid
from geometry.types import Bools, Cloud, Floats, Ints

TRIAL_POINTS = 1500  # of the scan, to choose among the signs of the principal axes
TRIAL_STEPS = 30
SPAN_ROUNDS = 30  # of the fit and the span that it shows to be seen
SPAN_CLOSE_MM = 0.003
CLUTTER = 1e-3  # of the scan may lie lower than the blade that it shows


@dataclass(frozen=True, slots=True, kw_only=True)
class ThesisRegisterSettings:
    """`close_mm` is the thesis' mu: the change of the root mean square error that ends a loop."""

    points: int = 60_000  # of the cloud, at most
    least_points: int = 200
    close_mm: float = 1e-6
    icp_steps: int = 400
    tuned_steps: int = 100
    explained_mm: float = 0.3

    def __post_init__(self) -> None:
        if not 50 <= self.least_points <= self.points:
            raise BadInput(f"thesis registration: {self} asks for too few points")
        if not (self.close_mm > 0.0 and self.explained_mm > 0.0):
            raise BadInput(f"thesis registration: {self} has a limit that is no distance")
        if not (self.icp_steps >= 1 and self.tuned_steps >= 1):
            raise BadInput(f"thesis registration: {self} allows no step")


def register_thesis(
    cloud: Cloud, nominal: Nominal, settings: ThesisRegisterSettings = ThesisRegisterSettings()
) -> Alignment:
    """The pose of the scan on the nominal, by the thesis' three steps.

    Principal axes (of the four proper choices of sign, the one that a short ICP brings nearest), then
    point-to-point ICP, then the fine-tuned alignment, each until the error settles. The nominal takes part
    down to where the scan ends: what a fixture hides would draw the scan along the span. Pairs of points
    hold the pose along the surface by their spacing alone, so it may slide where the shape does not say;
    what the kept points tell is in `information` and `weak_directions`.
    Raises `CannotRegister` for a cloud too small or without shape. Source: thesis 3.3.
    """
    if len(cloud) < settings.least_points:
        raise CannotRegister(f"{len(cloud)} scan points are fewer than {settings.least_points}")
    cloud = _thinned(cloud, settings.points)
    scan, whole = _scan_points(cloud.points_mm), _cad_points(nominal, cloud.points_mm)
    cad, icp, runner_up_ratio = _over_seen_span(scan, whole, nominal.z_min_mm, settings)
    tree = cKDTree(cad.points_mm)
    tuned = _match(scan, cad, tree, icp.T_nominal_scan, _alike, settings.close_mm, settings.tuned_steps)
    if tuned.kept.sum() < settings.least_points:
        raise CannotRegister(f"{int(tuned.kept.sum())} scan points resemble the nominal")
    return _alignment(cloud, nominal, tuned, icp, runner_up_ratio, settings)


def _over_seen_span(
    scan: "_Described", whole: "_Described", z_min_mm: float, settings: ThesisRegisterSettings
) -> tuple["_Described", "_Matched", float]:
    """The nominal's points down to where the scan ends, the scan's pose on them after ICP, and the runner-up
    ratio of its principal axes. Where it ends follows from the pose, so both are found in turns."""
    low_mm, cad = z_min_mm, whole.above(z_min_mm)
    tree = cKDTree(cad.points_mm)
    T_start, runner_up_ratio = _from_principal_axes(scan.points_mm, cad.points_mm, tree)
    hidden_mm = z_min_mm - float(whole.points_mm[:, 2].min())
    if _height_mm(T_start, scan.points_mm) > float(np.ptp(whole.points_mm[:, 2])) - 0.5 * hidden_mm:
        cad, tree = whole, cKDTree(whole.points_mm)  # nothing is hidden
    icp = _match(scan, cad, tree, T_start, _all, settings.close_mm, settings.icp_steps)
    for _ in range(SPAN_ROUNDS if cad is not whole else 0):
        before_mm, low_mm = low_mm, _lowest_mm(icp.T_nominal_scan, scan.points_mm)
        if abs(low_mm - before_mm) < SPAN_CLOSE_MM:
            break
        cad = whole.above(low_mm)
        tree = cKDTree(cad.points_mm)
        icp = _match(scan, cad, tree, icp.T_nominal_scan, _all, settings.close_mm, settings.icp_steps)
    return cad, icp, runner_up_ratio


def mask_thesis(cloud: Cloud, alignment: Alignment, nominal: Nominal) -> Bools:
    """The points (n,) of an aligned cloud that the L-curve cuts off, at the cloud's full density."""
    scan, cad = _scan_points(cloud.points_mm), _cad_points(nominal, cloud.points_mm)
    moved_mm = apply(alignment.T_nominal_scan, scan.points_mm)
    _, nearest = cKDTree(cad.points_mm).query(moved_mm)
    return ~_alike(moved_mm, scan, cad, nearest)


def _thinned(cloud: Cloud, most: int) -> Cloud:
    kept = every(len(cloud), most)
    kept = kept[near_each_other(cloud.points_mm[kept])]
    return cloud.of(kept)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Described:
    """Points with their balanced neighbourhoods and Gaussian curvatures; a NaN curvature is not known."""

    points_mm: Floats  # (n, 3)
    neighbours: Ints  # (n, k; -1 none)
    gaussian_per_mm2: Floats  # (n,)

    def above(self, z_mm: float) -> "_Described":
        """Those of the points at z_mm or above, and their neighbours that are."""
        kept = self.points_mm[:, 2] >= z_mm
        if kept.all():
            return self
        place = np.where(kept, np.cumsum(kept) - 1, -1)
        there = self.neighbours[kept]
        return _Described(
            points_mm=self.points_mm[kept],
            neighbours=np.where(there >= 0, place[there], -1),
            gaussian_per_mm2=self.gaussian_per_mm2[kept],
        )


def _lowest_mm(T_nominal_scan: Floats, scan_mm: Floats) -> float:
    """Where along the span the scan ends."""
    return float(np.quantile(apply(T_nominal_scan, scan_mm)[:, 2], CLUTTER))


def _height_mm(T_nominal_scan: Floats, scan_mm: Floats) -> float:
    low_mm, high_mm = np.quantile(apply(T_nominal_scan, scan_mm)[:, 2], [CLUTTER, 1.0 - CLUTTER])
    return float(high_mm - low_mm)


def _scan_points(points_mm: Floats) -> _Described:
    """Neighbourhoods and curvatures of a point set (thesis 3.3.2).

    The thesis takes its neighbourhoods by territory claiming (Khameneifar and Feng, 2017), which it does not
    spell out. Here the nearest candidates claim sectors of the tangent plane: eight sectors, two points each,
    taken in the order of distance. The quadric of eq. 3.3 is fitted as a height field over that plane, its
    one form that a nearly flat neighbourhood determines, and K of eq. 3.4 is taken at its foot.
    """
    shape = local_shape(points_mm)
    return _Described(
        points_mm=points_mm, neighbours=shape.neighbours, gaussian_per_mm2=shape.gaussian_per_mm2
    )


def _cad_points(nominal: Nominal, scan_mm: Floats) -> _Described:
    """The nominal but for its root end face, sampled as densely as the scan."""
    return _scan_points(sample_cad(nominal, ~nominal.end_face, pitch_of(scan_mm)).points_mm)


def _from_principal_axes(scan_mm: Floats, cad_mm: Floats, tree: cKDTree) -> tuple[Floats, float]:
    """The pose that lays principal axes on principal axes, and the second-best score over its own.

    Scores are mean distances after a short ICP of few points from each choice of signs.
    """
    T_principal_scan, T_nominal_principal = inverse(principal_frame(scan_mm)), principal_frame(cad_mm)
    flips = [np.diag([a, b, a * b, 1.0]) for a, b in product((1.0, -1.0), repeat=2)]
    starts = [T_nominal_principal @ flip @ T_principal_scan for flip in flips]
    few_mm = scan_mm[every(len(scan_mm), TRIAL_POINTS)]
    trials = [_short_icp(few_mm, cad_mm, tree, T) for T in starts]
    (best_mm, T_best), (second_mm, _), *_ = sorted(trials, key=lambda trial: trial[0])
    return T_best, second_mm / max(best_mm, 1e-9)


def _short_icp(points_mm: Floats, cad_mm: Floats, tree: cKDTree, T: Floats) -> tuple[float, Floats]:
    for _ in range(TRIAL_STEPS):
        _, nearest = tree.query(apply(T, points_mm))
        T = _best_motion(points_mm, cad_mm[nearest])
    distance_mm, _ = tree.query(apply(T, points_mm))
    return float(distance_mm.mean()), T


def _best_motion(points_mm: Floats, targets_mm: Floats) -> Floats:
    """The rigid motion that carries points (n, 3) nearest to their targets (n, 3), by squares (eq. 3.1)."""
    mean_mm, target_mm = points_mm.mean(axis=0), targets_mm.mean(axis=0)
    u, _, v = np.linalg.svd((points_mm - mean_mm).T @ (targets_mm - target_mm))
    sign = np.diag([1.0, 1.0, np.linalg.det(v.T @ u.T)])
    R = v.T @ sign @ u.T
    return rigid(R, target_mm - R @ mean_mm)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Matched:
    T_nominal_scan: Floats
    kept: Bools  # (n,) pairs that the pose was fitted to
    iterations: int
    converged: bool


Choice = Callable[[Floats, _Described, _Described, Ints], Bools]


def _match(
    scan: _Described,
    cad: _Described,
    tree: cKDTree,
    T: Floats,
    choose: Choice,
    close_mm: float,
    most: int,
) -> _Matched:
    """Nearest pairs, the choice among them, the best motion, until the error of the chosen pairs settles."""
    before_mm = np.inf
    for step in range(1, most + 1):
        moved_mm = apply(T, scan.points_mm)
        distance_mm, nearest = tree.query(moved_mm)
        kept = choose(moved_mm, scan, cad, nearest)
        rms_mm = float(np.sqrt(np.mean(distance_mm[kept] ** 2)))
        if abs(before_mm - rms_mm) < close_mm:
            return _Matched(T_nominal_scan=T, kept=kept, iterations=step, converged=True)
        T = _best_motion(scan.points_mm[kept], cad.points_mm[nearest[kept]])
        before_mm = rms_mm
    return _Matched(T_nominal_scan=T, kept=kept, iterations=most, converged=False)


def _all(moved_mm: Floats, scan: _Described, cad: _Described, nearest: Ints) -> Bools:
    return np.ones(len(moved_mm), np.bool_)


def _alike(moved_mm: Floats, scan: _Described, cad: _Described, nearest: Ints) -> Bools:
    """The pairs (n,) whose dissimilarity is below the corner of the L-curve."""
    dissimilarity = _dissimilarity(moved_mm, scan, cad, nearest)
    known = np.isfinite(dissimilarity)
    if not known.any():
        raise CannotRegister("no scan point has a neighbourhood")
    return np.asarray(known & (dissimilarity < corner_of_l_curve(dissimilarity[known])))


def _dissimilarity(moved_mm: Floats, scan: _Described, cad: _Described, nearest: Ints) -> Floats:
    """Geometric dissimilarity (n,) of each pair, 0 to 2 (eq. 3.7); NaN where a curvature is not known."""
    euclidean, curvature = average_hausdorff(
        np.ascontiguousarray(moved_mm),
        scan.gaussian_per_mm2,
        scan.neighbours,
        cad.points_mm,
        cad.gaussian_per_mm2,
        cad.neighbours,
        nearest,
    )
    return min_max(curvature) + min_max(euclidean)


def min_max(values: Floats) -> Floats:
    """The values (n,) brought to 0..1 between the least and the largest finite one (eq. 3.6)."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    return (values - low) / (high - low) if high > low else 0.0 * values


def corner_of_l_curve(values: Floats) -> float:
    """The value at the corner of the ascending values: nearest to the lower right end (eq. 3.8).

    The ranks are brought to the range of the values, so that the corner does not depend on their number.
    """
    ascending = np.sort(values)
    low, high = ascending[0], ascending[-1]
    rank = np.linspace(low, high, len(ascending))
    return float(ascending[np.argmin((rank - high) ** 2 + (ascending - low) ** 2)])


def _alignment(
    cloud: Cloud,
    nominal: Nominal,
    tuned: _Matched,
    icp: _Matched,
    runner_up_ratio: float,
    settings: ThesisRegisterSettings,
) -> Alignment:
    """What the pose is worth: residuals are those to the exact surface, not to its samples."""
    moved_mm = apply(tuned.T_nominal_scan, cloud.points_mm)
    found = nominal.closest(moved_mm)
    kept = tuned.kept & felt(nominal, found)
    residual_mm = found.distance_mm[kept]
    explained = np.abs(found.distance_mm[moved_mm[:, 2] >= nominal.z_min_mm]) <= settings.explained_mm
    return Alignment(
        method="thesis",
        T_nominal_scan=tuned.T_nominal_scan,
        pivot_mm=nominal.pivot_mm,
        information=information(nominal, moved_mm[kept], found.normals[kept], cloud.sigma_mm[kept]),
        weak_directions=solve_step(nominal, moved_mm, found, kept.astype(np.float64)).weak,
        rms_mm=float(np.sqrt(np.mean(residual_mm**2))),
        noise_mm=robust_sigma(residual_mm),
        inlier_fraction=float(kept.mean()),
        explained_fraction=float(explained.mean()) if len(explained) else 0.0,
        runner_up_ratio=runner_up_ratio,
        iterations=icp.iterations + tuned.iterations,
        converged=tuned.converged,
    )
