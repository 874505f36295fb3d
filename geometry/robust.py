"""Spread and weights that outliers do not move."""

import numpy as np

from geometry.types import Floats

TUKEY = 4.685  # standard deviations at which the biweight ends: 95 % efficient on normal residuals
NORMAL = 1.4826  # standard deviation of normal values over the median of their sizes


def spread(values: Floats) -> float:
    """Standard deviation about zero, from the median absolute value."""
    return NORMAL * float(np.median(np.abs(values)))


def robust_sigma(values: Floats) -> float:
    """Standard deviation of the values about their median, were they normal."""
    return spread(values - np.median(values))


def biweight(residuals: Floats, width: Floats | float) -> Floats:
    """Tukey's biweight (n,): 1 for no residual, 0 from `width` on."""
    q = np.clip(residuals / width, -1.0, 1.0)
    return np.asarray((1.0 - q * q) ** 2)
