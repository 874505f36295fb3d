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
def _shape(point: Floats, counts: Ints, per_axis: Floats, weights: Floats) -> int:
    """Fill the weights of the 64 nodes of the point's cell, ascending; returns the first node's number."""
    first = 0
    for axis in range(2, -1, -1):
        cell = min(max(int(np.floor(point[axis])), 0), counts[axis] - 4)
        _cubic(point[axis] - cell, per_axis[axis])
        first = first * counts[axis] + cell
    q = 0
    for c in range(4):
        for b in range(4):
            across = per_axis[2, c] * per_axis[1, b]
            for a in range(4):
                weights[q] = across * per_axis[0, a]
                q += 1
    return first


@njit(cache=True, nogil=True)
def shapes(points: Floats, counts: Ints) -> tuple[Ints, Floats]:
    """First node (n,) of each point's cell, and the weights (n, 64) of the cell's nodes, ascending."""
    first, weights = np.empty(len(points), np.int64), np.empty((len(points), 64))
    per_axis = np.empty((3, 4))
    for p in range(len(points)):
        first[p] = _shape(points[p], counts, per_axis, weights[p])
    return first, weights


@njit(cache=True, nogil=True)
def evaluate(points: Floats, counts: Ints, coefficients: Floats) -> Floats:
    """The spline (n, m) at points (n, 3) inside the lattice; `coefficients` (nodes, m)."""
    values = np.zeros((len(points), coefficients.shape[1]))
    per_axis, weights = np.empty((3, 4)), np.empty(64)
    for p in range(len(points)):
        first = _shape(points[p], counts, per_axis, weights)
        q = 0
        for c in range(4):
            for b in range(4):
                row = first + (c * counts[1] + b) * counts[0]
                for a in range(4):
                    for m in range(coefficients.shape[1]):
                        values[p, m] += weights[q] * coefficients[row + a, m]
                    q += 1
    return values


@njit(cache=True, nogil=True)
def add_block(bands: Floats, unknowns: Ints, block: Floats) -> None:
    """Add a symmetric block (k, k) at ascending `unknowns` (k,) to the lower half kept by columns.

    bands[j, i - j] = A[i, j] for i >= j.
    """
    for j in range(len(unknowns)):
        column = bands[unknowns[j]]
        for i in range(j, len(unknowns)):
            column[unknowns[i] - unknowns[j]] += block[i, j]
