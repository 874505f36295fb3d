"""Point-to-plane Gauss-Newton on the exact nominal: robust while damage is in, plain once it is out."""

from dataclasses import dataclass

import numpy as np

from geometry.blade.nominal import Closest, Nominal
from geometry.registration.ends import on_rim
from geometry.robust import TUKEY, biweight, robust_sigma
from geometry.transforms import apply, exp
from geometry.types import Bools, Floats, Ints

ANNEAL = (60.0, 40.0, 25.0, 15.0, 10.0, 7.0, 5.0, TUKEY)  # widths of the first steps, in robust sigmas
WEAK = 1e-5  # eigenvalue a point, of a unit displacement: the surface does not feel the motion
LONGEST_STEP_RAD = 0.3
LONGEST_KEPT_STEP_MM = 0.5  # a fit to points that were chosen near the surface has no reason to go farther


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """A pose, and the points as seen from it. `found` belongs to the pose, not to the one before."""

    T_nominal_scan: Floats
    found: Closest
    weak: tuple[tuple[float, ...], ...]
    iterations: int
    converged: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """A twist about the pivot, and the unit twists that the surface left free and the step did not use."""

    twist: Floats  # (6,)
    weak: tuple[tuple[float, ...], ...]
    size_mm: float  # how far it moves the surface, about


def felt(nominal: Nominal, found: Closest) -> Bools:
    """Points (n,) whose foot says something of the pose: none at the bottom end, where scans stop, nor on
    the rim of an end face: the few points that noise pushed past the end of a scan would hold its height.
    """
    return np.asarray(~(nominal.end_face[found.face] | on_rim(nominal, found.points_mm)))


def motions(moved_mm: Floats, normals: Floats, pivot_mm: Floats) -> Floats:
    """What a unit of each twist component moves each point along its normal: (n, 6)."""
    return np.column_stack([np.cross(moved_mm - pivot_mm, normals), normals])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """Equations beside those of the points: motion (k, 6) of each for unit twists, how far off, weights."""

    design: Floats
    off_mm: Floats
    weights: Floats


NO_ROWS = Rows(design=np.zeros((0, 6)), off_mm=np.zeros(0), weights=np.zeros(0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Held:
    """Heights that a fit keeps beside its points: the ends of a scan, each worth some points."""

    points_mm: Floats  # (k, 3) scan frame
    heights_mm: Floats  # (k,) of the nominal, where they belong
    weights: Floats  # (k,)

    def rows(self, T_nominal_scan: Floats, pivot_mm: Floats) -> Rows:
        moved_mm = apply(T_nominal_scan, self.points_mm)
        upward = np.tile([0.0, 0.0, 1.0], (len(moved_mm), 1))
        return Rows(
            design=motions(moved_mm, upward, pivot_mm),
            off_mm=moved_mm[:, 2] - self.heights_mm,
            weights=self.weights,
        )


NOTHING_HELD = Held(points_mm=np.zeros((0, 3)), heights_mm=np.zeros(0), weights=np.zeros(0))


def solve_step(
    nominal: Nominal, moved_mm: Floats, found: Closest, weights: Floats, beside: Rows = NO_ROWS
) -> Step:
    """The Gauss-Newton step, not along directions whose eigenvalue is below `WEAK` a point.

    Rotations are measured by the displacement at the surface's radius of gyration, so that eigenvalues of
    all six directions compare. Degeneracy after Zhang, Kaess and Singh (2016).
    """
    scale = unit_motions(nominal)
    design = np.concatenate([motions(moved_mm, found.normals, nominal.pivot_mm), beside.design]) * scale
    weights = np.concatenate([weights, beside.weights])
    weighted = design * weights[:, None]
    values, vectors = np.linalg.eigh(weighted.T @ design)
    strong = values > WEAK * max(float(weights.sum()), 1.0)
    along = vectors.T @ (weighted.T @ np.concatenate([found.distance_mm, beside.off_mm]))
    scaled = -vectors @ np.where(strong, along / np.where(strong, values, 1.0), 0.0)
    twist = scaled * scale
    twist *= min(1.0, LONGEST_STEP_RAD / (float(np.linalg.norm(twist[:3])) + 1e-12))
    weak = tuple(unit_twist(vectors[:, i] * scale) for i in np.flatnonzero(~strong))
    return Step(twist=twist, weak=weak, size_mm=float(np.linalg.norm(scaled)))


def unit_motions(nominal: Nominal) -> Floats:
    """How much of each component (6,) of a twist displaces a point at the radius of gyration by 1 mm."""
    return np.concatenate([np.full(3, 1.0 / nominal.gyration_mm), np.ones(3)])


def unit_twist(twist: Floats) -> tuple[float, ...]:
    return tuple(float(x) for x in twist / np.linalg.norm(twist))


def fit_robust(
    points_mm: Floats, T_nominal_scan: Floats, nominal: Nominal, *, steps: int = 60, close_mm: float = 2e-5
) -> Fit:
    """The pose by Tukey's weights, their width annealed from wide to 4.685 robust sigmas."""
    T, face = T_nominal_scan, np.zeros(0, np.int64)
    weak: tuple[tuple[float, ...], ...] = ()
    for k in range(steps):
        moved_mm = apply(T, points_mm)
        found = nominal.closest(moved_mm) if k < len(ANNEAL) else nominal.closest_from(moved_mm, face)
        face = found.face
        weights = tukey(found.distance_mm, ~nominal.end_face[found.face], ANNEAL[min(k, len(ANNEAL) - 1)])
        step = solve_step(nominal, moved_mm, found, weights)
        T, weak = exp(step.twist, nominal.pivot_mm) @ T, step.weak
        if k >= len(ANNEAL) and step.size_mm < close_mm:
            break
    found = nominal.closest(apply(T, points_mm))
    return Fit(T_nominal_scan=T, found=found, weak=weak, iterations=k + 1, converged=step.size_mm < close_mm)


def tukey(distance_mm: Floats, used: Bools, width: float) -> Floats:
    """Tukey's biweights (n,) of the residuals, the scale from the `used` ones; 0 for the rest."""
    scale_mm = max(robust_sigma(distance_mm[used]), 1e-9) if used.any() else 1.0
    return np.where(used, biweight(distance_mm, width * scale_mm), 0.0)


def fit_kept(
    points_mm: Floats,
    start: Fit,
    shares: Floats | Bools,
    nominal: Nominal,
    held: Held = NOTHING_HELD,
    *,
    steps: int = 15,
    close_mm: float = 2e-5,
) -> Fit:
    """The pose by least squares over the points, each counting for its share (n,), and what is `held`.

    Whether the surface feels a point is decided at the start: a point that changes sides on the way would
    send the steps to and fro.
    """
    T, found, weak = start.T_nominal_scan, start.found, start.weak
    weights = np.where(felt(nominal, found), shares, 0.0)
    taken, size_mm = 0, np.inf
    while taken < steps and size_mm >= close_mm:
        moved_mm = apply(T, points_mm)
        step = solve_step(nominal, moved_mm, found, weights, held.rows(T, nominal.pivot_mm))
        twist = step.twist * min(1.0, LONGEST_KEPT_STEP_MM / (step.size_mm + 1e-12))
        T, weak = exp(twist, nominal.pivot_mm) @ T, step.weak
        found = nominal.closest_from(apply(T, points_mm), found.face)
        taken, size_mm = taken + 1, step.size_mm
    return Fit(T_nominal_scan=T, found=found, weak=weak, iterations=taken, converged=size_mm < close_mm)


def information(
    nominal: Nominal, moved_mm: Floats, normals: Floats, sigma_mm: Floats, shares: Floats | float = 1.0
) -> Floats:
    """Inverse covariance (6, 6) of the twist about the pivot, from independent noise along the normals.

    Of points that count for uneven `shares` (n,) of the fit noise averages away less.
    """
    uneven = float(np.mean(np.square(shares)) / np.mean(shares) ** 2)
    design = motions(moved_mm, normals, nominal.pivot_mm) / (sigma_mm * np.sqrt(uneven))[:, None]
    return np.asarray(design.T @ design)


def every(points: int, most: int) -> Ints:
    """Indices of at most `most` of the points, evenly through them."""
    return np.arange(0, points, max(1, -(-points // most)))
