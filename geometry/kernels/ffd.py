"""Volumetric cubic B-spline: displacement at points, and the normal equations of a point-to-plane fit.

Points are in lattice units (cell edge 1, first cell at 0). Coefficient k = (c * nb + b) * na + a for lattice
node (a, b, c) of `counts` = (na, nb, nc); unknown m k + component for a field of m components.
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
def _support(point: Floats, counts: Ints, per_axis: Floats, nodes: Ints, weights: Floats) -> None:
    """Fill the 64 lattice nodes around a point, ascending, and their weights."""
    cell = np.empty(3, np.int64)
    for axis in range(3):
        cell[axis] = min(max(int(np.floor(point[axis])), 0), counts[axis] - 4)
        _cubic(point[axis] - cell[axis], per_axis[axis])
    q = 0
    for c in range(4):
        for b in range(4):
            row = ((cell[2] + c) * counts[1] + cell[1] + b) * counts[0] + cell[0]
            across = per_axis[2, c] * per_axis[1, b]
            for a in range(4):
                nodes[q] = row + a
                weights[q] = across * per_axis[0, a]
                q += 1


@njit(cache=True, nogil=True)
def evaluate(points: Floats, counts: Ints, coefficients: Floats) -> Floats:
    """The spline (n, m) at points (n, 3) inside the lattice; `coefficients` (nodes, m)."""
    values = np.zeros((len(points), coefficients.shape[1]))
    per_axis, nodes, weights = np.empty((3, 4)), np.empty(64, np.int64), np.empty(64)
    for p in range(len(points)):
        _support(points[p], counts, per_axis, nodes, weights)
        for q in range(64):
            for m in range(coefficients.shape[1]):
                values[p, m] += weights[q] * coefficients[nodes[q], m]
    return values


@njit(cache=True, nogil=True)
def assemble(
    points: Floats,
    directions: Floats,
    offsets: Floats,
    weights: Floats,
    tangential: float,
    counts: Ints,
    bands: Floats,
    right: Floats,
) -> None:
    """Add the normal equations of `directions . D(points) = offsets` to `bands` and `right`.

    D has as many components as `directions` (n, m) has columns. `bands` (unknowns, width) holds the lower half
    by columns: bands[j, i - j] = A[i, j]. Each point also asks for D = 0 in its first three components with the
    fraction `tangential` of its weight, so that the surface does not slide along itself where nothing holds it.
    """
    size = directions.shape[1]
    per_axis, nodes, shape = np.empty((3, 4)), np.empty(64, np.int64), np.empty(64)
    metric = np.empty((size, size))
    for p in range(len(points)):
        _support(points[p], counts, per_axis, nodes, shape)
        for a in range(size):
            for b in range(size):
                metric[a, b] = weights[p] * directions[p, a] * directions[p, b]
            if a < 3:
                metric[a, a] += weights[p] * tangential
        for i in range(64):
            for a in range(size):
                right[size * nodes[i] + a] += weights[p] * shape[i] * offsets[p] * directions[p, a]
            for j in range(i + 1):
                both = shape[i] * shape[j]
                lag = size * (nodes[i] - nodes[j])
                for b in range(size):
                    column = bands[size * nodes[j] + b]
                    for a in range(size):
                        if lag + a - b >= 0:
                            column[lag + a - b] += both * metric[a, b]
