"""The pose of a scan on the nominal, and how certain it is."""

from dataclasses import dataclass, field

import numpy as np

from geometry.types import Floats

FREE = np.array([0.02, 0.02, 0.02, 1.0, 1.0, 1.0])  # rad and mm: sigmas of a motion that nothing holds


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alignment:
    """The pose of the scan on the nominal, how it was found and how certain it is.

    A pose error is a twist (rx, ry, rz in rad, tx, ty, tz in mm) that turns about `pivot_mm` and
    then shifts, applied on the nominal side: `exp(twist, pivot_mm) @ T_nominal_scan`.
    `information` (6, 6) is the inverse covariance of that twist from point noise alone;
    `form_covariance` (6, 6) is what the form of the part adds to that covariance: deviations that many
    neighbouring points share. Both together are the uncertainty of the pose. `unseen_covariance` (6, 6) is
    what of it the best fit of the whole part, all seen and sound, would not have: with the noise it is the
    uncertainty of what is measured from that best fit.
    """

    method: str
    T_nominal_scan: Floats  # (4, 4)
    pivot_mm: Floats  # (3,), nominal frame
    information: Floats  # (6, 6)
    weak_directions: tuple[tuple[float, ...], ...]  # unit twists the surface leaves free, or nearly so
    rms_mm: float  # of the kept points, along the normal
    noise_mm: float  # robust standard deviation of the kept residuals
    inlier_fraction: float  # kept as undamaged
    explained_fraction: float  # scan points that the nominal explains (within a few tenths of a mm)
    runner_up_ratio: float  # score of the second-best coarse pose over the best; 1 = ambiguous
    iterations: int
    converged: bool
    form_covariance: Floats = field(default_factory=lambda: np.zeros((6, 6)))
    unseen_covariance: Floats = field(default_factory=lambda: np.zeros((6, 6)))


def noise_covariance(alignment: Alignment) -> Floats:
    """Covariance (6, 6) of the pose twist from noise; where the surface leaves it free, that of `FREE`."""
    return np.linalg.inv(alignment.information + np.diag(FREE**-2.0)).astype(np.float64)


def pose_covariance(alignment: Alignment) -> Floats:
    """Covariance (6, 6) of the twist from the best fit of the whole part: of noise and of what was not seen.

    Where noise, or what was not seen, leaves a motion free, it counts as `FREE` at most.
    """
    unseen, free = alignment.unseen_covariance, np.diag(FREE**2.0)
    return noise_covariance(alignment) + unseen @ np.linalg.solve(free + unseen, free)


def variance_along(alignment: Alignment, point_mm: Floats, normal: Floats) -> float:
    """Variance (mm^2) of the pose from the best fit at a point (3,) along a normal (3,), nominal frame."""
    lever = np.concatenate([np.cross(point_mm - alignment.pivot_mm, normal), normal])
    return float(lever @ pose_covariance(alignment) @ lever)
