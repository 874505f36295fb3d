"""Cloud onto nominal: coarse, iterative closest point, robust fine fit."""

from dataclasses import dataclass

from geometry.types import Floats


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alignment:
    """The pose of the scan on the nominal, how it was found and how certain it is.

    A pose error is a twist (rx, ry, rz in rad, tx, ty, tz in mm) that turns about `pivot_mm` and
    then shifts, applied on the nominal side: `exp(twist, pivot_mm) @ T_nominal_scan`.
    `information` (6, 6) is the inverse covariance of that twist from point noise alone.
    """

    method: str
    T_nominal_scan: Floats  # (4, 4)
    pivot_mm: Floats  # (3,), nominal frame
    information: Floats  # (6, 6)
    weak_directions: tuple[tuple[float, ...], ...]  # unit twists the surface leaves free
    rms_mm: float  # of the kept points, along the normal
    noise_mm: float  # robust standard deviation of the kept residuals
    inlier_fraction: float  # kept as undamaged
    explained_fraction: float  # scan points that the nominal explains (within a few tenths of a mm)
    runner_up_ratio: float  # score of the second-best coarse pose over the best; 1 = ambiguous
    iterations: int
    converged: bool
