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
    """The spline (n, 4) at points (n, 3) inside the lattice; `coefficients` (nodes, 4)."""
    values = np.empty((len(points), 4))
    grid = coefficients.reshape(counts[2], counts[1], 4 * counts[0])
    u, v, w = np.empty(4), np.empty(4), np.empty(4)
    for p in range(len(points)):
        a = min(max(int(np.floor(points[p, 0])), 0), counts[0] - 4)
        b = min(max(int(np.floor(points[p, 1])), 0), counts[1] - 4)
        c = min(max(int(np.floor(points[p, 2])), 0), counts[2] - 4)
        _cubic(points[p, 0] - a, u)
        _cubic(points[p, 1] - b, v)
        _cubic(points[p, 2] - c, w)
        s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
        for k in range(4):
            for j in range(4):
                across = w[k] * v[j]
                row = grid[c + k, b + j, 4 * a : 4 * a + 16]
                s0 += across * (u[0] * row[0] + u[1] * row[4] + u[2] * row[8] + u[3] * row[12])
                s1 += across * (u[0] * row[1] + u[1] * row[5] + u[2] * row[9] + u[3] * row[13])
                s2 += across * (u[0] * row[2] + u[1] * row[6] + u[2] * row[10] + u[3] * row[14])
                s3 += across * (u[0] * row[3] + u[1] * row[7] + u[2] * row[11] + u[3] * row[15])
        values[p, 0], values[p, 1], values[p, 2], values[p, 3] = s0, s1, s2, s3
    return values
