"""Volumetric cubic B-spline on a lattice of unit cells, the first at 0.

Lattice node (a, b, c) of `counts` = (na, nb, nc) has the number (c * nb + b) * na + a.
"""

import numpy as np
from numba import njit

from geometry.types import Floats, Ints


@njit(cache=True, nogil=True, inline="always")
def _cubic(t, weights):  # type: ignore[no-untyped-def]
    """Fill the four uniform cubic B-spline weights at the fraction t of a cell."""
    s = 1.0 - t
    weights[0] = s * s * s / 6.0
    weights[1] = (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0
    weights[2] = (3.0 * s * s * s - 6.0 * s * s + 4.0) / 6.0
    weights[3] = t * t * t / 6.0


@njit(cache=True, nogil=True)
def evaluate(points: Floats, counts: Ints, coefficients: Floats) -> Floats:
    """The spline (n, m) at points (n, 3) inside the lattice; `coefficients` (nodes, m)."""
    values = np.zeros((len(points), coefficients.shape[1]))
    per_axis = np.empty((3, 4))
    for p in range(len(points)):
        first = 0
        for axis in range(2, -1, -1):
            cell = min(max(int(np.floor(points[p, axis])), 0), counts[axis] - 4)
            _cubic(points[p, axis] - cell, per_axis[axis])
            first = first * counts[axis] + cell
        for c in range(4):
            for b in range(4):
                across = per_axis[2, c] * per_axis[1, b]
                row = first + (c * counts[1] + b) * counts[0]
                for a in range(4):
                    weight = across * per_axis[0, a]
                    for m in range(coefficients.shape[1]):
                        values[p, m] += weight * coefficients[row + a, m]
    return values
