"""Recursive weighted local least squares in the plane: domains that grow, and the mean of their curves."""

import math

import numpy as np
from numba import njit

from geometry.types import Floats, Ints

_SINGULAR = 1e-12  # of a pivot against its own diagonal


@njit(cache=True, nogil=True)
def _solve(moments: Floats, right: Floats, out: Floats) -> bool:
    """The parabola of the moments sum w x^0..4 and sum w y x^0..2, by elimination; False if undetermined."""
    m0, m1, m2, m3, m4 = moments
    if not m0 > 0.0:
        return False
    first, second = m1 / m0, m2 / m0
    pivot = m2 - first * m1
    if not pivot > _SINGULAR * m2:
        return False
    third = (m3 - second * m1) / pivot
    last = m4 - second * m2 - third * (m3 - second * m1)
    if not last > _SINGULAR * m4:
        return False
    middle = right[1] - first * right[0]
    out[2] = (right[2] - second * right[0] - third * middle) / last
    out[1] = middle / pivot - third * out[2]
    out[0] = right[0] / m0 - first * out[1] - second * out[2]
    return True


@njit(cache=True, nogil=True)
def _local(points: Floats, normals: Floats, i: int, q: int) -> tuple[float, float]:
    """Point `q` along the tangent (right of the normal) and along the normal of point `i`."""
    dx, dy = points[q, 0] - points[i, 0], points[q, 1] - points[i, 1]
    nx, ny = normals[i, 0], normals[i, 1]
    return dx * ny - dy * nx, dx * nx + dy * ny


@njit(cache=True, nogil=True)
def _two_sides(points: Floats, normals: Floats, near: Ints, i: int, order: Ints) -> int:
    """`order`: the point itself, then its neighbours from either side of the normal in turn; their number."""
    right = left = 1
    order[0] = i
    for turn in range(len(near) - 1):
        wanted_right = turn % 2 == 0
        j = right if wanted_right else left
        while j < len(near) and (_local(points, normals, i, near[j])[0] >= 0.0) != wanted_right:
            j += 1
        if j == len(near):
            return turn + 1
        order[turn + 1] = near[j]
        if wanted_right:
            right = j + 1
        else:
            left = j + 1
    return len(near)


@njit(cache=True, nogil=True)
def grow_domains(
    points: Floats, normals: Floats, weights: Floats, nearest: Ints, limit: float
) -> tuple[Ints, Ints, Floats]:
    """The largest feasible domain of each point and its parabola.

    Points (n, 2) with unit normals (n, 2) and weights (n,); `nearest` (n, k) by distance, itself first. From
    three points on, one neighbour at a time and the two sides of the normal in turn, the domain grows until
    the root mean square of the parabola's residuals exceeds `limit`; the curve before that one is kept.
    Gives the members (n, k), their number (n,), at least 3 or 0 where three never determined a parabola, and
    the coefficients (n, 3) of 1, x, x^2 in each point's own frame. The least squares estimate is updated
    through its moments, one point's products at a time: so is its sum of squares.
    Source: thesis 4.3.2.2, equations 4.5 and 4.6.
    """
    n, k = nearest.shape
    members = np.empty((n, k), np.int64)
    size = np.zeros(n, np.int64)
    curves = np.zeros((n, 3))
    weighted, plain = np.empty(5), np.empty(5)
    right, sums, c = np.empty(3), np.empty(3), np.empty(3)
    for i in range(n):
        available = _two_sides(points, normals, nearest[i], i, members[i])
        weighted[:], plain[:], right[:], sums[:], square = 0.0, 0.0, 0.0, 0.0, 0.0
        for m in range(available):
            q = members[i, m]
            x, y = _local(points, normals, i, q)
            power = 1.0
            for e in range(5):
                weighted[e] += weights[q] * power
                plain[e] += power
                if e < 3:
                    right[e] += weights[q] * power * y
                    sums[e] += power * y
                power *= x
            square += y * y
            if m < 2 or not _solve(weighted, right, c):
                continue
            fitted = c[0] * sums[0] + c[1] * sums[1] + c[2] * sums[2]
            own = c[0] * c[0] * plain[0] + c[1] * c[1] * plain[2] + c[2] * c[2] * plain[4]
            own += 2.0 * (c[0] * c[1] * plain[1] + c[0] * c[2] * plain[2] + c[1] * c[2] * plain[3])
            if m >= 3 and square - 2.0 * fitted + own > limit * limit * (m + 1):
                break
            curves[i] = c
            size[i] = m + 1
    return members, size, curves


@njit(cache=True, nogil=True)
def blend_curves(
    points: Floats, normals: Floats, members: Ints, size: Ints, curves: Floats
) -> tuple[Floats, Floats, Floats, Ints]:
    """Thinned points (n, 2), filtered unit normals (n, 2), spread (n,) and number of curves (n,).

    Every curve whose domain holds a point projects it along the curve's own normal direction: the thinned
    point is the mean (thesis equation 4.7), the spread their standard deviation along the point's normal.
    The normal map merges the two nearest of the curves' normals into their sum until one is left: that
    is the sum of all, in whatever order. 0 curves: the point itself.
    """
    n = len(points)
    thin, direction = np.zeros((n, 2)), np.zeros((n, 2))
    total, square = np.zeros(n), np.zeros(n)
    count = np.zeros(n, np.int64)
    for i in range(n):
        nx, ny = normals[i]
        for m in range(size[i]):
            q = members[i, m]
            x, _ = _local(points, normals, i, q)
            y = curves[i, 0] + x * (curves[i, 1] + x * curves[i, 2])
            at_x, at_y = points[i, 0] + x * ny + y * nx, points[i, 1] - x * nx + y * ny
            off = (at_x - points[q, 0]) * normals[q, 0] + (at_y - points[q, 1]) * normals[q, 1]
            slope = curves[i, 1] + 2.0 * x * curves[i, 2]
            side = 1.0 / math.sqrt(1.0 + slope * slope)
            mx, my = (nx - slope * ny) * side, (ny + slope * nx) * side
            if mx * normals[q, 0] + my * normals[q, 1] < 0.0:
                mx, my = -mx, -my
            thin[q, 0] += at_x
            thin[q, 1] += at_y
            direction[q, 0] += mx
            direction[q, 1] += my
            total[q] += off
            square[q] += off * off
            count[q] += 1
    spread = np.zeros(n)
    for i in range(n):
        length = math.hypot(direction[i, 0], direction[i, 1])
        if count[i] == 0 or length == 0.0:
            thin[i], direction[i] = points[i], normals[i]
            continue
        thin[i] /= count[i]
        direction[i] /= length
        spread[i] = math.sqrt(max(square[i] / count[i] - (total[i] / count[i]) ** 2, 0.0))
    return thin, direction, spread, count


@njit(cache=True, nogil=True)
def pull_back(
    points: Floats, normals: Floats, weights: Floats, members: Ints, size: Ints, functions: Floats
) -> Floats:
    """(n, f): growth of linear functions of the thinned points with each point's own displacement.

    `functions` (n, f): their growth with the thinned points' displacements along the normals. Domains and
    weights are held; the normals within a domain are taken as one.
    """
    n, f = functions.shape
    out = np.zeros((n, f))
    count = np.zeros(n)
    for i in range(n):
        for m in range(size[i]):
            count[members[i, m]] += 1.0
    moments, column, solved = np.empty(5), np.empty(3), np.empty(3)
    inverse, sums = np.empty((3, 3)), np.empty((3, f))
    for i in range(n):
        moments[:], sums[:] = 0.0, 0.0
        for m in range(size[i]):
            q = members[i, m]
            x, _ = _local(points, normals, i, q)
            for j in range(f):
                share = functions[q, j] / count[q]
                sums[0, j] += share
                sums[1, j] += share * x
                sums[2, j] += share * x * x
            power = weights[q]
            for e in range(5):
                moments[e] += power
                power *= x
        for e in range(3):
            column[:] = 0.0
            column[e] = 1.0
            _solve(moments, column, solved)
            inverse[e] = solved
        sums[:] = inverse @ sums
        for m in range(size[i]):
            q = members[i, m]
            x, _ = _local(points, normals, i, q)
            for j in range(f):
                out[q, j] += weights[q] * (sums[0, j] + x * (sums[1, j] + x * sums[2, j]))
    return out
