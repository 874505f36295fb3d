"""Projection of points on stacked section curves, and sums of a tensor spline fit."""

import math

import numpy as np
from numba import njit

from geometry.types import Floats, Ints


@njit(cache=True, nogil=True)
def _node(nodes_mm: Floats, layer: int, up: float, j: int) -> tuple[float, float]:
    """Node `j` of the curve at the fraction `up` between `layer` and the next one but one: a parabola."""
    a = (1.0 - up) * (1.0 - 2.0 * up)
    b = 4.0 * up * (1.0 - up)
    c = up * (2.0 * up - 1.0)
    low, middle, high = nodes_mm[layer, j], nodes_mm[layer + 1, j], nodes_mm[layer + 2, j]
    return a * low[0] + b * middle[0] + c * high[0], a * low[1] + b * middle[1] + c * high[1]


@njit(cache=True, nogil=True)
def _descend(nodes_mm: Floats, layer: int, up: float, x: float, y: float, start: int) -> tuple[int, float]:
    """The locally nearest node, walking from `start` with shrinking strides, and its squared distance."""
    m = nodes_mm.shape[1]
    j = start
    nx, ny = _node(nodes_mm, layer, up, j)
    best = (nx - x) ** 2 + (ny - y) ** 2
    stride = 8
    while stride >= 1:
        for direction in (stride, -stride):
            while True:
                k = (j + direction) % m
                nx, ny = _node(nodes_mm, layer, up, k)
                d2 = (nx - x) ** 2 + (ny - y) ** 2
                if d2 >= best:
                    break
                j, best = k, d2
        stride //= 2
    return j, best


@njit(cache=True, nogil=True)
def _foot(
    nodes_mm: Floats, layer: int, up: float, x: float, y: float, j: int
) -> tuple[float, float, float, float]:
    """Foot on the two segments that meet in node `j`: node coordinate, signed distance, outward normal."""
    m = nodes_mm.shape[1]
    cx, cy = _node(nodes_mm, layer, up, j)
    best = math.inf
    foot = 0.0
    fx = fy = nx = ny = 0.0
    for side in (-1, 0):
        ax, ay = _node(nodes_mm, layer, up, (j + side) % m)
        bx, by = _node(nodes_mm, layer, up, (j + side + 1) % m)
        ex, ey = bx - ax, by - ay
        length2 = ex * ex + ey * ey + 1e-300
        f = min(1.0, max(0.0, ((x - ax) * ex + (y - ay) * ey) / length2))
        qx, qy = ax + f * ex, ay + f * ey
        d2 = (x - qx) ** 2 + (y - qy) ** 2
        length = math.sqrt(length2)
        if d2 < best:
            best, foot, fx, fy = d2, j + side + f, qx, qy
            nx, ny = ey / length, -ex / length
    if fx == cx and fy == cy:  # on the node itself: the mean normal decides inside and outside
        ax, ay = _node(nodes_mm, layer, up, (j - 1) % m)
        bx, by = _node(nodes_mm, layer, up, (j + 1) % m)
        length = math.hypot(bx - ax, by - ay) + 1e-300
        nx, ny = (by - ay) / length, (ax - bx) / length
    distance = math.sqrt(best)
    if (x - fx) * nx + (y - fy) * ny < 0.0:
        distance = -distance
    return foot % m, distance, nx, ny


@njit(cache=True, nogil=True)
def project(
    points_mm: Floats, z_mm: Floats, nodes_mm: Floats, seeds: Ints, corner_mm: Floats, cell_mm: float
) -> Floats:
    """(n, 4) of every point: node coordinate in [0, m), signed in-plane distance, outward normal x, y.

    `nodes_mm` (2 k + 1, m, 2) are counter-clockwise curves at the heights `z_mm` (2 k + 1,) whose nodes
    correspond; every odd one lies halfway between its neighbours, and a parabola in height blends the
    three. `seeds` (nx, ny, 2) name for each cell a start node and, where the other side of the airfoil may
    be as near, one there, else -1.
    """
    out = np.empty((len(points_mm), 4))
    for i in range(len(points_mm)):
        x, y, z = points_mm[i]
        layer = min(max(np.searchsorted(z_mm, z, side="right") - 1, 0), len(z_mm) - 3) // 2 * 2
        up = (z - z_mm[layer]) / (z_mm[layer + 2] - z_mm[layer])
        cx = min(max(int((x - corner_mm[0]) / cell_mm), 0), seeds.shape[0] - 1)
        cy = min(max(int((y - corner_mm[1]) / cell_mm), 0), seeds.shape[1] - 1)
        j, best = _descend(nodes_mm, layer, up, x, y, seeds[cx, cy, 0])
        if seeds[cx, cy, 1] >= 0:
            k, other = _descend(nodes_mm, layer, up, x, y, seeds[cx, cy, 1])
            if other < best:
                j = k
        out[i] = _foot(nodes_mm, layer, up, x, y, j)
    return out


@njit(cache=True, nogil=True)
def _cubic(f: float, b: Floats) -> None:
    """The four uniform cubic B-splines at the fraction `f` of a knot span."""
    g = 1.0 - f
    b[0] = g * g * g / 6.0
    b[1] = (3.0 * f * f * f - 6.0 * f * f + 4.0) / 6.0
    b[2] = (-3.0 * f * f * f + 3.0 * f * f + 3.0 * f + 1.0) / 6.0
    b[3] = f * f * f / 6.0


@njit(cache=True, nogil=True)
def tensor_sums(
    u: Floats, v: Floats, y: Floats, weight: Floats, extra: Floats, shape: tuple[int, int]
) -> tuple[Floats, Floats, Floats]:
    """Weighted sums of a periodic-by-open cubic tensor spline with `extra` plain columns.

    `u` in knot spans of the periodic direction, `v` in knot spans from the first one of the open one,
    `shape` the numbers of coefficients (p, q). Gives `gram` (p, 4, q, q): sum of the products of the
    coefficients (i, k) and (i + d, l); `right` (p, q): against `y`; `cross` (p, q, e): against `extra`.
    """
    p, q = shape
    e = extra.shape[1]
    gram = np.zeros((p, 4, q, q))
    right = np.zeros((p, q))
    cross = np.zeros((p, q, e))
    bu = np.empty(4)
    bv = np.empty(4)
    for n in range(len(u)):
        if weight[n] == 0.0:
            continue
        i0 = int(u[n])
        k0 = min(max(int(v[n]), 0), q - 4)
        _cubic(u[n] - i0, bu)
        _cubic(v[n] - k0, bv)
        for a in range(4):
            i = (i0 + a) % p
            wa = weight[n] * bu[a]
            for k in range(4):
                wak = wa * bv[k]
                right[i, k0 + k] += wak * y[n]
                for c in range(e):
                    cross[i, k0 + k, c] += wak * extra[n, c]
            for d in range(4 - a):
                wad = wa * bu[a + d]
                for k in range(4):
                    for m in range(4):
                        gram[i, d, k0 + k, k0 + m] += wad * bv[k] * bv[m]
    return gram, right, cross


@njit(cache=True, nogil=True)
def tensor_values(u: Floats, v: Floats, coefficients: Floats) -> Floats:
    """The tensor spline of `tensor_sums` at (u, v): (n,)."""
    p, q = coefficients.shape
    out = np.empty(len(u))
    bu = np.empty(4)
    bv = np.empty(4)
    for n in range(len(u)):
        i0 = int(u[n])
        k0 = min(max(int(v[n]), 0), q - 4)
        _cubic(u[n] - i0, bu)
        _cubic(v[n] - k0, bv)
        value = 0.0
        for a in range(4):
            for k in range(4):
                value += bu[a] * bv[k] * coefficients[(i0 + a) % p, k0 + k]
        out[n] = value
    return out


@njit(cache=True, nogil=True)
def band_inverse(factor: Floats) -> Floats:
    """The entries of `(L L')^-1` inside the band of `L`, in the same lower band storage (w + 1, n).

    `factor[d, j]` is L[j + d, j], as `scipy.linalg.cholesky_banded(lower=True)` gives it.
    Source: Takahashi, Fagan and Chin 1973, the recursion from the last column to the first.
    """
    width, n = factor.shape
    inverse = np.zeros((width, n))
    for j in range(n - 1, -1, -1):
        reach = min(width - 1, n - 1 - j)
        for d in range(reach, -1, -1):
            i = j + d
            total = 0.0
            for k in range(j + 1, i + 1):
                total += factor[k - j, j] * inverse[i - k, k]
            for k in range(max(i, j) + 1, j + reach + 1):
                total += factor[k - j, j] * inverse[k - i, i]
            own = 1.0 / factor[0, j] if d == 0 else 0.0
            inverse[d, j] = (own - total) / factor[0, j]
    return inverse


@njit(cache=True, nogil=True)
def cubic_weights(t: Floats, first: Ints) -> Floats:
    """The four cubic B-splines (n, 4) of the knot span `first` (n,) at `t` (n,), in knot spans."""
    out = np.empty((len(t), 4))
    for n in range(len(t)):
        _cubic(t[n] - first[n], out[n])
    return out
