"""The exponential that compilers can make vectors of: loops with the C library's run one number at a time."""

import numpy as np
from numba import njit

LOG2_E = 1.0 / np.log(2.0)
LN2_HIGH, LN2_LOW = 0.693145751953125, 1.42860682030941723212e-6  # sum ln 2; the first, times 2^10, is exact
TAYLOR = tuple(1.0 / float(np.prod(np.arange(1.0, k + 1.0))) for k in range(13, 0, -1))
FARTHEST = 700.0  # beyond, as good as nothing
BIAS, FRACTION_BITS = 1023, 52  # of a double's exponent


# fastmath=False: unsaid, it would take the freedom of whoever compiles it first, and lose digits.
@njit(cache=True, nogil=True, fastmath=False)
def decay(a: float) -> float:
    """exp(-a) for a >= 0, to the last bit or two; from `FARTHEST` on it falls no further.

    A power of two times Taylor's polynomial over half of ln 2 to either side.
    """
    x = -min(a, FARTHEST)
    twos = np.floor(x * LOG2_E + 0.5)
    rest = x - twos * LN2_HIGH - twos * LN2_LOW
    sum_ = 0.0
    for each in TAYLOR:
        sum_ = sum_ * rest + each
    sum_ = sum_ * rest + 1.0
    return float(sum_ * np.int64((np.int64(twos) + BIAS) << FRACTION_BITS).view(np.float64))
