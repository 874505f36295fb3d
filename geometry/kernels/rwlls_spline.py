"""A closed cubic B-spline through ordered points, with one segment more until it is near enough."""

import math

import numpy as np
from numba import njit

from geometry.types import Floats, Ints


@njit(cache=True, nogil=True)
def place_knots(t: Floats, m: int) -> Floats:
    """The knots (m + 7,) of `m` closed segments over ascending parameters `t` (n,) of [0, 1).

    The inner ones by averaging, so that every segment holds data; three on either side repeat
    the period. Source: de Boor 1978, as in Piegl and Tiller, equations 9.68 and 9.69.
    """
    knots = np.empty(m + 7)
    each = len(t) / m
    knots[3], knots[m + 3] = 0.0, 1.0
    for j in range(1, m):
        i = int(j * each)
        part = j * each - i
        knots[3 + j] = (1.0 - part) * t[i - 1] + part * t[i]
    for j in range(3):
        knots[j], knots[m + 4 + j] = knots[m + j] - 1.0, knots[4 + j] + 1.0
    return knots


@njit(cache=True, nogil=True)
def cubic_basis(knots: Floats, t: Floats) -> tuple[Ints, Floats]:
    """The first of the four splines that are not zero at each ascending `t` (n,), and the four (n, 4)."""
    first, values = np.empty(len(t), np.int64), np.empty((len(t), 4))
    last = len(knots) - 5
    k = 3
    for i in range(len(t)):
        x = t[i]
        while k < last and x >= knots[k + 1]:
            k += 1
        r1, r2, r3 = knots[k + 1] - x, knots[k + 2] - x, knots[k + 3] - x
        l1, l2, l3 = x - knots[k], x - knots[k - 1], x - knots[k - 2]
        a = 1.0 / (r1 + l1)
        b0, b1 = r1 * a, l1 * a
        a, b = b0 / (r1 + l2), b1 / (r2 + l1)
        b0, b1, b2 = r1 * a, l2 * a + r2 * b, l1 * b
        a, b, c = b0 / (r1 + l3), b1 / (r2 + l2), b2 / (r3 + l1)
        values[i, 0], values[i, 3] = r1 * a, l1 * c
        values[i, 1], values[i, 2] = l3 * a + r2 * b, l2 * b + r3 * c
        first[i] = k - 3
    return first, values


@njit(cache=True, nogil=True)
def _normal_equations(first: Ints, values: Floats, points: Floats, gram: Floats, right: Floats) -> None:
    """Lower half of the Gram matrix (m, m), a cyclic band of three, and the right sides (m, 2)."""
    m = len(gram)
    band, sides = np.zeros((m + 3, 4)), np.zeros((m + 3, 2))
    for i in range(len(first)):
        for a in range(4):
            row = first[i] + a
            sides[row, 0] += values[i, a] * points[i, 0]
            sides[row, 1] += values[i, a] * points[i, 1]
            for b in range(a + 1):
                band[row, a - b] += values[i, a] * values[i, b]
    gram[:], right[:] = 0.0, 0.0
    for row in range(m + 3):
        i = row % m
        right[i] += sides[row]
        for d in range(min(row, 3) + 1):
            j = (row - d) % m
            twice = 2.0 if d > 0 and i == j else 1.0  # three segments: a spline meets itself
            gram[max(i, j), min(i, j)] += twice * band[row, d]


@njit(cache=True, nogil=True)
def _solve_cyclic(a: Floats, b: Floats) -> bool:
    """Solve a x = b in place by Cholesky; `a` (m, m), lower half, is a cyclic band of three.

    Outside the band the factor fills only its last three rows. False if not positive definite.
    """
    m = len(a)
    for j in range(m):
        square = a[j, j]
        for k in range(0 if j >= m - 3 else max(0, j - 3), j):
            square -= a[j, k] * a[j, k]
        if not square > 1e-14 * a[j, j]:
            return False
        a[j, j] = math.sqrt(square)
        i = j + 1
        while i < m:
            total = a[i, j]
            for k in range(0 if i >= m - 3 and j >= m - 3 else max(0, j - 3), j):
                total -= a[i, k] * a[j, k]
            a[i, j] = total / a[j, j]
            i = i + 1 if i < j + 3 else max(i + 1, m - 3)
    for i in range(m):
        for k in range(0 if i >= m - 3 else max(0, i - 3), i):
            b[i] -= a[i, k] * b[k]
        b[i] /= a[i, i]
    for i in range(m - 1, -1, -1):
        b[i] /= a[i, i]
        for k in range(0 if i >= m - 3 else max(0, i - 3), i):
            b[k] -= a[i, k] * b[i]
    return True


@njit(cache=True, nogil=True)
def fit_closed(t: Floats, points: Floats, m: int) -> tuple[Floats, Floats, float]:
    """Knots (m + 7,), control points (m, 2) and residual rms of the closed spline of `m` segments.

    Least squares over points (n, 2) at ascending parameters `t` (n,) of [0, 1); the rms of their distances
    to the curve at their own parameters is infinite where the points do not determine the spline.
    """
    knots = place_knots(t, m)
    first, values = cubic_basis(knots, t)
    gram, control = np.empty((m, m)), np.empty((m, 2))
    _normal_equations(first, values, points, gram, control)
    if not _solve_cyclic(gram, control):
        return knots, control, math.inf
    square = 0.0
    for i in range(len(t)):
        x, y = points[i]
        for a in range(4):
            k = (first[i] + a) % m
            x -= values[i, a] * control[k, 0]
            y -= values[i, a] * control[k, 1]
        square += x * x + y * y
    return knots, control, math.sqrt(square / len(t))


@njit(cache=True, nogil=True)
def fit_progressively(t: Floats, points: Floats, limit: float, most: int) -> tuple[Floats, Floats, float]:
    """`fit_closed` with the fewest segments, from six control points on, whose rms is below `limit`.

    With `most` segments (at least 3) where fewer were never enough, whatever their rms.
    """
    knots, control, rms = fit_closed(t, points, 3)
    m = 3
    while not rms < limit and m < most:
        m += 1
        knots, control, rms = fit_closed(t, points, m)
    return knots, control, rms
