"""The turntable's axis in the scanner's frame, from a sphere that rides on the table."""

from dataclasses import dataclass
from math import isfinite

import numpy as np

from geometry.errors import BadInput, CannotMeasure
from geometry.transforms import about_z, apply, check_rigid, inverse, rigid
from geometry.types import Floats, Ints

MIN_ANGLES = 5  # two more than a circle has unknowns, so that its scatter is known
MIN_TURN_DEG = 90.0  # of arc that the sphere must see for its circle to be known
MIN_CHECK_DEG = 180.0  # of arc round which a ball must be seen for its place to prove the axis


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AxisCalibration:
    """Where the table stands: `x_scanner = T_scanner_table0 @ about_z(angle) @ x_table`.

    The table frame has +Z along the axis. `sigma_offset_mm` is the standard uncertainty of the axis' place
    in each direction across itself, `sigma_tilt_deg` that of its tilt in each.
    """

    T_scanner_table0: Floats  # (4, 4)
    sigma_offset_mm: float
    sigma_tilt_deg: float

    def __post_init__(self) -> None:
        check_rigid(self.T_scanner_table0, "axis calibration")
        sigmas = (self.sigma_offset_mm, self.sigma_tilt_deg)
        if not all(isfinite(s) and s >= 0.0 for s in sigmas):
            raise BadInput(f"axis calibration: uncertainties {sigmas} are not numbers >= 0")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BallPlaces:
    """Mean centre of each ball in the table frame, and the largest distance of a single view from it."""

    places_mm: Floats  # (balls, 3)
    stray_mm: float


def calibrate_axis(sphere_centres_mm: Floats, angles_deg: Floats) -> AxisCalibration:
    """The axis round which a sphere's centres (k, 3), scanner frame, turn with the table angles (k,).

    Least squares of centre = p + a cos(angle) + b sin(angle): the axis passes through p along a x b. The
    frame's origin is p, its x axis the scanner's x (or y, if x is along the axis) levelled. Uncertainties
    are the residuals' over k, and over the circle's radius. Raises `CannotMeasure` unless at least five
    angles spread over a quarter turn show a circle that is clear of its own scatter.
    """
    angles_rad = np.deg2rad(angles_deg)
    if len(angles_rad) < MIN_ANGLES:
        raise CannotMeasure(f"axis: {len(angles_rad)} angles, {MIN_ANGLES} are needed")
    if not _spread_deg(angles_deg) >= MIN_TURN_DEG:
        raise CannotMeasure(f"axis: the angles do not show a turn of {MIN_TURN_DEG:g} deg")
    design = np.column_stack([np.ones(len(angles_rad)), np.cos(angles_rad), np.sin(angles_rad)])
    (p_mm, a_mm, b_mm), *_ = np.linalg.lstsq(design, sphere_centres_mm, rcond=None)
    sigma_mm = _scatter_mm(sphere_centres_mm - design @ np.stack([p_mm, a_mm, b_mm]))
    radius_mm = float(np.sqrt(np.linalg.norm(np.cross(a_mm, b_mm))))
    covariance = np.linalg.inv(design.T @ design) * sigma_mm**2
    offset_mm, circle_mm = np.sqrt(covariance[0, 0]), np.sqrt(0.5 * (covariance[1, 1] + covariance[2, 2]))
    if not radius_mm > 10.0 * circle_mm:
        raise CannotMeasure(f"axis: circle of {radius_mm:.3f} mm, known to {circle_mm:.3f} mm only")
    return AxisCalibration(
        T_scanner_table0=rigid(_level_frame(np.cross(a_mm, b_mm)), p_mm),
        sigma_offset_mm=float(offset_mm),
        sigma_tilt_deg=float(np.rad2deg(circle_mm / radius_mm)),
    )


def ball_places(axis: AxisCalibration, centres_mm: Floats, angles_deg: Floats, ball: Ints) -> BallPlaces:
    """Where each ball of an artefact on the table comes to lie in the table frame, and how far it strays.

    `centres_mm` (k, 3), scanner frame, of ball number `ball` (k,) at table angle `angles_deg` (k,). A ball
    stays where it is only if axis, angles and scanner are right; after VDI/VDE 2634-3, multi-view. Raises
    `CannotMeasure` unless each ball was seen round half a turn.
    """
    table_mm = np.array(
        [
            apply(inverse(axis.T_scanner_table0 @ about_z(a)), x[None])[0]
            for a, x in zip(angles_deg, centres_mm, strict=True)
        ]
    )
    numbers = np.unique(ball)
    for number in numbers:
        if not _spread_deg(angles_deg[ball == number]) >= MIN_CHECK_DEG:
            raise CannotMeasure(f"ball {number}: not seen round {MIN_CHECK_DEG:g} deg of the table")
    means_mm = np.array([table_mm[ball == number].mean(axis=0) for number in numbers])
    strays_mm = [
        np.linalg.norm(table_mm[ball == n] - mean, axis=1).max()
        for n, mean in zip(numbers, means_mm, strict=True)
    ]
    return BallPlaces(places_mm=means_mm, stray_mm=float(max(strays_mm)))


def find_sphere(points_mm: Floats, radius_mm: float) -> tuple[Floats, float]:
    """Centre (3,) of a sphere of known radius fitted to points (n, 3) on its cap, and the residuals' rms.

    Gauss-Newton from the algebraic sphere. Raises `CannotMeasure` for points that do not show a cap.
    """
    centre_mm = _algebraic_centre(points_mm)
    for _ in range(50):
        away_mm = points_mm - centre_mm
        distance_mm = np.linalg.norm(away_mm, axis=1)
        step_mm, *_ = np.linalg.lstsq(away_mm / distance_mm[:, None], distance_mm - radius_mm, rcond=None)
        centre_mm = centre_mm + step_mm
        if np.linalg.norm(step_mm) < 1e-9:
            rms_mm = float(np.sqrt(np.mean((distance_mm - radius_mm) ** 2)))
            return centre_mm, rms_mm
    raise CannotMeasure(f"sphere: no centre found for {len(points_mm)} points")


def _algebraic_centre(points_mm: Floats) -> Floats:
    mean_mm = points_mm.mean(axis=0)
    local_mm = points_mm - mean_mm
    design = np.column_stack([2.0 * local_mm, np.ones(len(local_mm))])
    solution, _, rank, _ = np.linalg.lstsq(design, np.sum(local_mm**2, axis=1), rcond=1e-9)
    if rank < 4:
        raise CannotMeasure(f"sphere: {len(points_mm)} points lie in a plane")
    return np.asarray(mean_mm + solution[:3])


def _spread_deg(angles_deg: Floats) -> float:
    """The turn less its largest unvisited gap."""
    around = np.sort(np.mod(angles_deg, 360.0))
    gaps = np.diff(around, append=around[0] + 360.0)
    return 360.0 - float(gaps.max())


def _scatter_mm(residual_mm: Floats) -> float:
    """Standard deviation a coordinate, three parameters taken out of each."""
    return float(np.sqrt(np.sum(residual_mm**2) / (3.0 * (len(residual_mm) - 3))))


def _level_frame(axis: Floats) -> Floats:
    """Rotation (3, 3) whose z column is along `axis`, its x column the nearest to the scanner's x (or y)."""
    z = axis / np.linalg.norm(axis)
    towards = np.eye(3)[0 if abs(z[0]) < 0.9 else 1]
    x = towards - (towards @ z) * z
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])
