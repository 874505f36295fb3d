"""What several views saw: the turntable's axis on which they agree best, and how well they then agree."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from geometry.kernels.neighbours import k_nearest
from geometry.kernels.overlap import heights_over_others
from geometry.robust import spread
from geometry.scan.calibrate import AxisCalibration
from geometry.scan.fuse import fuse
from geometry.scan.surface import local_shape
from geometry.threads import one_blas_thread
from geometry.transforms import about_z, apply, exp, inverse
from geometry.types import Bools, Floats, Ints, View

NEIGHBOURS = 16
EACH = 3  # neighbours of the point's own view, and of others, that make an overlap
ASIDE = 0.2  # of the neighbourhood's radius: where one view ends, the tilt of its normals would count
TURN_RAD = 0.2  # of the surface over a neighbourhood beyond which its normal means little
MOST_POINTS = 200_000
LEAST_POINTS = 50
PATCH_MM = 4.0  # heights so near each other rest on the same points, and may err alike
WIDE_MM, SYSTEMATIC = 30.0, 0.05  # over so much of a view, a scanner errs alike by this share of a sigma
ROUNDS = 3
CLIP = 3.0  # robust sigmas beyond which a disagreement is no shift of the axis
EXACT_MM = 1e-5  # no scanner tells less


@dataclass(frozen=True, slots=True, kw_only=True)
class Overlap:
    """How one view lies on all others, along the surface normal.

    `bias_mm` is the rms of what the best rigid motion of the view would correct: a view that is noisy but
    in its place has a large `rms_mm` and no bias. It is not corrected.
    """

    view: int
    points: int  # that have enough neighbours of other views
    rms_mm: float
    bias_mm: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RefinedAxis:
    """The axis on which the views agree best, and what they still say against it."""

    axis: AxisCalibration
    moved_sigmas: float  # largest of its four corrections, in standard uncertainties of the calibration
    surface_mm: float  # the largest standard uncertainty that it leaves to a surface point along its normal
    overlaps: tuple[Overlap, ...]  # a view without enough overlap is absent


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Shared:
    """Points, and how high the view of each lies there over other views.

    `felt` (n, 4) is what a unit of (rx, ry in rad, tx, ty in mm) adds to a height.
    """

    points_mm: Floats  # (n, 3)
    normals: Floats  # (n, 3) towards the scanner of that view
    view: Ints  # (n,)
    height_mm: Floats  # (n,)
    felt: Floats  # (n, 4)
    sigma_mm: float  # of a point along its normal

    def of(self, chosen: Bools) -> "_Shared":
        return _Shared(
            points_mm=self.points_mm[chosen],
            normals=self.normals[chosen],
            view=self.view[chosen],
            height_mm=self.height_mm[chosen],
            felt=self.felt[chosen],
            sigma_mm=self.sigma_mm,
        )


@one_blas_thread
def refine_axis(views: Sequence[View], axis: AxisCalibration, sigma_mm: float) -> RefinedAxis:
    """The axis that makes the views agree best where they overlap, within what its calibration says of it.

    Maximum a posteriori over offset and tilt (4 parameters): the calibration with its standard
    uncertainties is the prior; the data are heights of one view over the others, along the local
    normal where the surface is nearly flat, clipped at three robust sigmas and counted as independent only
    from patch to patch (sandwich estimator; White, 1980), with a share that the scanner errs by over wider
    ones. What all views lie too near to the scanner is estimated beside it: a flat blade tells the two
    apart by little. Turn about the axis and height along it move all views alike and stay. Views that do
    not overlap leave the calibration as it was. `sigma_mm` as for `fuse`, whose error it raises.
    """
    scale = np.array([np.deg2rad(axis.sigma_tilt_deg)] * 2 + [axis.sigma_offset_mm] * 2)
    shared = _shared(views, axis, sigma_mm)
    moved, posterior = np.zeros(5), np.eye(5)
    if len(shared.view) >= LEAST_POINTS:
        for _ in range(ROUNDS):
            moved, posterior = _posterior(shared, scale, moved)
    error, covariance = moved[:4] * scale, posterior[:4, :4] * np.outer(scale, scale)
    return RefinedAxis(
        axis=_corrected(axis, error, covariance),
        moved_sigmas=float(np.abs(moved[:4]).max()),
        surface_mm=_surface_mm(views, axis, covariance),
        overlaps=_overlaps(replace(shared, height_mm=shared.height_mm + shared.felt @ error)),
    )


def _shared(views: Sequence[View], axis: AxisCalibration, sigma_mm: float) -> _Shared:
    """Of every n-th point, so that `MOST_POINTS` are taken, those whose heights tell."""
    cloud = fuse(views, axis, sigma_mm)
    taken = slice(None, None, max(1, len(cloud) // MOST_POINTS))
    points_mm, view = cloud.points_mm[taken], cloud.view[taken]
    turned = np.repeat([v.angle_deg for v in views], [len(v.points_mm) for v in views])[taken]
    nearest, apart_mm = k_nearest(points_mm, min(NEIGHBOURS, len(points_mm)))
    towards = np.array([axis.T_scanner_table0[2, :3] @ about_z(v.angle_deg)[:3, :3] for v in views])
    normals, bend_per_mm = _shape_in_its_view(points_mm, view)
    lit = np.repeat(towards, [len(v.points_mm) for v in views], axis=0)[taken]
    normals = np.where(np.einsum("ni,ni->n", normals, lit)[:, None] < 0.0, -normals, normals)
    height_mm, felt, aside_mm, fewer = heights_over_others(
        points_mm, normals, np.deg2rad(turned), view, nearest
    )
    flat = np.abs(bend_per_mm) * apart_mm[:, -1] < TURN_RAD
    usable = flat & (fewer >= EACH) & (aside_mm < ASIDE * apart_mm[:, -1]) & np.isfinite(height_mm)
    return _Shared(
        points_mm=points_mm, normals=normals, view=view, height_mm=height_mm, felt=felt, sigma_mm=sigma_mm
    ).of(usable)


def _shape_in_its_view(points_mm: Floats, view: Ints) -> tuple[Floats, Floats]:
    """Normals (n, 3) and mean curvatures (n,) by the points of the same view alone.

    A normal through the points of two views would lean so as to take up part of the step between them."""
    normals, bend_per_mm = np.full(points_mm.shape, np.nan), np.full(len(points_mm), np.nan)
    for number in np.unique(view):
        mine = np.flatnonzero(view == number)
        if len(mine) >= NEIGHBOURS:
            shape = local_shape(points_mm[mine], candidates=NEIGHBOURS)
            normals[mine], bend_per_mm[mine] = shape.normals, shape.mean_per_mm
    return normals, bend_per_mm


def _posterior(shared: _Shared, scale: Floats, moved: Floats) -> tuple[Floats, Floats]:
    """Mean (5,) and covariance (5, 5) of the axis error in units of `scale` and of what every view lies too
    near to the scanner, mm; `moved` (5,) is what is clipped about."""
    design = np.column_stack([shared.felt * scale, np.ones(len(shared.view))])
    left_mm = shared.height_mm + design @ moved
    near = np.abs(left_mm) <= max(CLIP * spread(left_mm), EXACT_MM)
    design, height_mm = design[near], shared.height_mm[near]
    weight = _weight(design, height_mm, shared.of(near))
    prior = np.diag([1.0, 1.0, 1.0, 1.0, 0.0])
    posterior: Floats = np.linalg.inv(weight * (design.T @ design) + prior).astype(np.float64)
    return -posterior @ (weight * (design.T @ height_mm)), posterior


def _weight(design: Floats, height_mm: Floats, shared: _Shared) -> float:
    """Of one height: the inverse of its variance, raised by what heights near each other have in common."""
    backward = np.linalg.pinv(design.T @ design, rcond=1e-9, hermitian=True)
    residual_mm = height_mm - design @ (backward @ (design.T @ height_mm))
    near = _sums(design * residual_mm[:, None], np.floor(shared.points_mm / PATCH_MM))
    wide = _sums(design, np.column_stack([shared.view, np.floor(shared.points_mm / WIDE_MM)]))
    common = near @ near.T + (SYSTEMATIC * shared.sigma_mm) ** 2 * (wide @ wide.T)
    variance_mm2 = float(np.trace(backward @ common)) / design.shape[1]
    return 1.0 / max(variance_mm2, float(np.mean(residual_mm**2)), EXACT_MM**2)


def _sums(rows: Floats, keys: Floats) -> Floats:
    """The rows (n, p) summed over equal keys: (p, groups)."""
    group = np.unique(keys.astype(np.int64), axis=0, return_inverse=True)[1].ravel()
    return np.stack([np.bincount(group, column) for column in rows.T])


def _corrected(axis: AxisCalibration, error: Floats, covariance: Floats) -> AxisCalibration:
    """The axis tilted and shifted by (rx, ry in rad, tx, ty in mm), table frame."""
    twist = np.array([error[0], error[1], 0.0, error[2], error[3], 0.0])
    tilt_rad, offset_mm = np.sqrt(np.diag(covariance).reshape(2, 2).mean(axis=1))
    return AxisCalibration(
        T_scanner_table0=axis.T_scanner_table0 @ exp(twist, np.zeros(3)),
        sigma_offset_mm=float(offset_mm),
        sigma_tilt_deg=float(np.rad2deg(tilt_rad)),
    )


def _surface_mm(views: Sequence[View], axis: AxisCalibration, covariance: Floats) -> float:
    """The largest standard deviation of a point, in its worst direction, that the covariance (4, 4) gives."""
    seen_mm = np.concatenate([view.points_mm[:: 1 + len(view.points_mm) // 500] for view in views])
    x, y, z = apply(inverse(axis.T_scanner_table0), seen_mm).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    moves = np.array([[zero, z, one, zero], [-z, zero, zero, one], [y, -x, zero, zero]])  # r x q + t
    spread = np.einsum("ain,ij,bjn->nab", moves, covariance, moves)
    return float(np.sqrt(max(np.linalg.eigvalsh(spread).max(initial=0.0), 0.0)))


def _overlaps(shared: _Shared) -> tuple[Overlap, ...]:
    each = [_overlap(shared.of(shared.view == view), int(view)) for view in np.unique(shared.view)]
    return tuple(overlap for overlap in each if overlap.points >= LEAST_POINTS)


def _overlap(mine: _Shared, view: int) -> Overlap:
    local_mm = mine.points_mm - mine.points_mm.mean(axis=0)
    motions = np.column_stack([np.cross(local_mm, mine.normals), mine.normals])
    twist, *_ = np.linalg.lstsq(motions, mine.height_mm, rcond=1e-6)
    return Overlap(
        view=view,
        points=len(mine.view),
        rms_mm=float(np.sqrt(np.mean(mine.height_mm**2))),
        bias_mm=float(np.sqrt(np.mean((motions @ twist) ** 2))),
    )
