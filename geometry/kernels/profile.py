"""Projection of points on stacked section curves, and sums of a tensor spline fit."""

import math

import numpy as np
from numba import njit

from geometry.types import Bools, Floats, Ints


@njit(cache=True, nogil=True)
def _wrap(j: int, m: int) -> int:
    """`j` in [0, m) for -m <= j < 2 m; a division is slower than all else that is done to a node."""
    if j >= m:
        return j - m
    return j + m if j < 0 else j


@njit(cache=True, nogil=True)
def _node(curves: Floats, three: int, up: float, j: int) -> tuple[float, float]:
    """Node `j` of the curve at the fraction `up` of the interval `three`: a parabola in height."""
    x = curves[three, j, 0] + up * (curves[three, j, 2] + up * curves[three, j, 4])
    y = curves[three, j, 1] + up * (curves[three, j, 3] + up * curves[three, j, 5])
    return x, y


@njit(cache=True, nogil=True)
def _descend(curves: Floats, three: int, up: float, x: float, y: float, start: int) -> tuple[int, float]:
    """The locally nearest node, by a jump along the tangent at `start` and then step by step; distance^2."""
    m = curves.shape[1]
    j = start
    nx, ny = _node(curves, three, up, j)
    best = (nx - x) ** 2 + (ny - y) ** 2
    px, py = _node(curves, three, up, _wrap(j + 1, m))
    ex, ey = px - nx, py - ny
    jump = round(((x - nx) * ex + (y - ny) * ey) / (ex * ex + ey * ey + 1e-300))
    if jump != 0:
        k = _wrap(j + min(max(jump, -40), 40), m)
        nx, ny = _node(curves, three, up, k)
        d2 = (nx - x) ** 2 + (ny - y) ** 2
        if d2 < best:
            j, best = k, d2
    stride = 4
    while stride >= 1:
        for direction in (stride, -stride):
            while True:
                k = _wrap(j + direction, m)
                nx, ny = _node(curves, three, up, k)
                d2 = (nx - x) ** 2 + (ny - y) ** 2
                if d2 >= best:
                    break
                j, best = k, d2
        stride //= 4
    return j, best


@njit(cache=True, nogil=True)
def _foot(
    curves: Floats, three: int, up: float, x: float, y: float, j: int
) -> tuple[float, float, float, float]:
    """Foot on the two segments that meet in node `j`: node coordinate, signed distance, outward normal."""
    m = curves.shape[1]
    cx, cy = _node(curves, three, up, j)
    lx, ly = _node(curves, three, up, _wrap(j - 1, m))
    rx, ry = _node(curves, three, up, _wrap(j + 1, m))
    best = math.inf
    foot = 0.0
    fx = fy = nx = ny = 0.0
    for side in (-1, 0):
        ax, ay = (lx, ly) if side < 0 else (cx, cy)
        bx, by = (cx, cy) if side < 0 else (rx, ry)
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
        length = math.hypot(rx - lx, ry - ly) + 1e-300
        nx, ny = (ry - ly) / length, (lx - rx) / length
    distance = math.sqrt(best)
    if (x - fx) * nx + (y - fy) * ny < 0.0:
        distance = -distance
    return foot if foot >= 0.0 else foot + m, distance, nx, ny


@njit(cache=True, nogil=True)
def _interval(z_mm: Floats, z: float) -> tuple[int, float]:
    """The interval between the even ones of `z_mm` that holds a height or is next to it; the fraction."""
    three = 0
    while three < len(z_mm) // 2 - 1 and z >= z_mm[2 * three + 2]:
        three += 1
    return three, (z - z_mm[2 * three]) / (z_mm[2 * three + 2] - z_mm[2 * three])


@njit(cache=True, nogil=True, inline="always")
def _nearest(
    curves: Floats,
    three: int,
    up: float,
    x: float,
    y: float,
    seeds: Ints,
    across_mm: Floats,
    corner_mm: Floats,
    cell_mm: float,
) -> int:
    """The nearest node of the curve at the fraction `up` of the interval `three`."""
    cx = min(max(int((x - corner_mm[0]) / cell_mm), 0), seeds.shape[0] - 1)
    cy = min(max(int((y - corner_mm[1]) / cell_mm), 0), seeds.shape[1] - 1)
    j, best = _descend(curves, three, up, x, y, seeds[cx, cy, 0])
    if seeds[cx, cy, 1] >= 0 and 16.0 * best > across_mm[j] ** 2:
        k, other = _descend(curves, three, up, x, y, seeds[cx, cy, 1])
        if other < best:
            j = k
    return j


@njit(cache=True, nogil=True)
def project(
    points_mm: Floats,
    z_mm: Floats,
    curves: Floats,
    seeds: Ints,
    across_mm: Floats,
    corner_mm: Floats,
    cell_mm: float,
) -> Floats:
    """(n, 4) of every point: node coordinate in [0, m), signed in-plane distance, outward normal x, y.

    `curves` (k, m, 6) are counter-clockwise curves whose nodes correspond, one for each interval of height
    between the even ones of `z_mm` (2 k + 1,): x, y, their slope and their bend over the interval.
    `seeds` (nx, ny, 2) name for each cell a start node and, where the other side of the airfoil may be as
    near, one there, else -1. `across_mm` (m,): how far the other side is from each node; it is not looked
    at for a point within a quarter of that.
    """
    out = np.empty((len(points_mm), 4))
    for i in range(len(points_mm)):
        x, y = points_mm[i, 0], points_mm[i, 1]
        three, up = _interval(z_mm, points_mm[i, 2])
        j = _nearest(curves, three, up, x, y, seeds, across_mm, corner_mm, cell_mm)
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = _foot(curves, three, up, x, y, j)
    return out


@njit(cache=True, nogil=True)
def nearest_nodes(points_mm: Floats, curve_mm: Floats) -> Ints:
    """For each point (m, 2) the locally nearest node of a closed curve (m, 2), sought from its own number."""
    m = len(curve_mm)
    out = np.empty(m, np.int64)
    for i in range(m):
        j = i
        best = (curve_mm[i, 0] - points_mm[i, 0]) ** 2 + (curve_mm[i, 1] - points_mm[i, 1]) ** 2
        for direction in (8, -8, 1, -1):
            while True:
                k = _wrap(j + direction, m)
                d2 = (curve_mm[k, 0] - points_mm[i, 0]) ** 2 + (curve_mm[k, 1] - points_mm[i, 1]) ** 2
                if d2 >= best:
                    break
                j, best = k, d2
        out[i] = j
    return out


@njit(cache=True, nogil=True)
def _steep(j: int, three: int, up: float, growth: Floats, trusted: Bools) -> float:
    """Outward growth of the surface with height about node `j`; NaN where its parabola is not trusted."""
    near = 2 * three + (0 if up < 0.25 else (1 if up < 0.75 else 2))
    return growth[near, j] if trusted[three, j] else math.nan


@njit(cache=True, nogil=True)
def steepness(node: Floats, z: Floats, z_mm: Floats, growth: Floats, trusted: Bools) -> Floats:
    """Outward growth (n,) of a surface with height at the nearest curve of `project`; NaN where not trusted.

    `growth` (2 k + 1, m) at the nodes, `trusted` (k, m) for each parabola.
    """
    out = np.empty(len(node))
    for i in range(len(node)):
        three, up = _interval(z_mm, z[i])
        out[i] = _steep(int(node[i]), three, up, growth, trusted)
    return out


@njit(cache=True, nogil=True)
def _undone(
    x: float, y: float, height: float, pivot_mm: Floats, rest: Floats, per_mm: Floats
) -> tuple[float, float]:
    """A place so high over the section taken back by a motion."""
    x -= pivot_mm[0] + rest[0] + per_mm[0] * height
    y -= pivot_mm[1] + rest[1] + per_mm[1] * height
    turn = rest[2] + per_mm[2] * height
    c, s = math.cos(turn), math.sin(turn)
    return c * x + s * y + pivot_mm[0], c * y - s * x + pivot_mm[1]


@njit(cache=True, nogil=True)
def undo_motion(points_mm: Floats, pivot_mm: Floats, z_mm: float, rest: Floats, per_mm: Floats) -> Floats:
    """Points (n, 3) taken back by a motion (x, y, turn) `rest` at `z_mm` that grows `per_mm` of height."""
    out = np.empty_like(points_mm)
    for i in range(len(points_mm)):
        x, y, z = points_mm[i, 0], points_mm[i, 1], points_mm[i, 2]
        out[i, 0], out[i, 1] = _undone(x, y, z - z_mm, pivot_mm, rest, per_mm)
        out[i, 2] = z
    return out


@njit(cache=True, nogil=True)
def lay(
    points_mm: Floats,
    motion: tuple[Floats, float, Floats, Floats],
    surface: tuple[Floats, Floats, Floats, Bools],
    grid: tuple[Ints, Floats, Floats, float],
    limits: tuple[float, float],
) -> tuple[Ints, Floats, Floats]:
    """The points that belong to a profile, as what `band_misfit` takes of them.

    `motion` as `undo_motion` takes it, `surface` (`z_mm`, `curves`, `growth`, `trusted`) and `grid` (`seeds`,
    `across_mm`, `corner_mm`, `cell_mm`) as `project` and `steepness` do. Points belong that lie within
    `limits` of the curve, where it is no steeper. Returns their numbers (k,), (k, 3) node coordinate,
    height, and how much longer a distance in the plane is than along the surface normal, and (k, 6)
    signed distance, arm x, y, outward normal x, y and height over the section.
    """
    pivot_mm, section_mm, rest, per_mm = motion
    z_mm, curves, growth, trusted = surface
    seeds, across_mm, corner_mm, cell_mm = grid
    capture_mm, steepest = limits
    number, place = np.empty(len(points_mm), np.int64), np.empty((len(points_mm), 3))
    rows = np.empty((len(points_mm), 6))
    used = 0
    for i in range(len(points_mm)):
        z = points_mm[i, 2]
        height = z - section_mm
        x, y = _undone(points_mm[i, 0], points_mm[i, 1], height, pivot_mm, rest, per_mm)
        three, up = _interval(z_mm, z)
        j = _nearest(curves, three, up, x, y, seeds, across_mm, corner_mm, cell_mm)
        foot, distance, nx, ny = _foot(curves, three, up, x, y, j)
        steep = _steep(int(foot), three, up, growth, trusted)
        if abs(distance) <= capture_mm and abs(steep) <= steepest:
            number[used] = i
            place[used, 0], place[used, 1], place[used, 2] = foot, z, math.sqrt(1.0 + steep * steep)
            rows[used, 0], rows[used, 3], rows[used, 4] = distance, nx, ny
            rows[used, 1], rows[used, 2] = x - pivot_mm[0], y - pivot_mm[1]
            rows[used, 5] = height
            used += 1
    return number[:used], place[:used], rows[:used]


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
            i = _wrap(i0 + a, p)
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
                value += bu[a] * bv[k] * coefficients[_wrap(i0 + a, p), k0 + k]
        out[n] = value
    return out


@njit(cache=True, nogil=True)
def band_inverse(factor: Floats) -> Floats:
    """The entries of `(L L')^-1` inside the band of `L`, in the same lower band storage (w + 1, n).

    `factor[d, j]` is L[j + d, j], as `scipy.linalg.cholesky_banded(lower=True)` gives it.
    Source: Takahashi, Fagan and Chin 1973, the recursion from the last column to the first. The part of
    the inverse that a column needs is kept square, row k in place k modulo w.
    """
    width, n = factor.shape
    ring = max(width - 1, 1)
    lower = np.ascontiguousarray(factor.T)
    inverse = np.zeros((n, width))
    near, pull = np.zeros((ring, ring)), np.empty(ring)
    for j in range(n - 1, -1, -1):
        reach, own = min(width - 1, n - 1 - j), 1.0 / lower[j, 0]
        pull[:] = 0.0
        for d in range(1, reach + 1):
            row, f = near[(j + d) % ring], lower[j, d]
            for k in range(ring):
                pull[k] += f * row[k]
        total = 0.0
        for d in range(1, reach + 1):
            inverse[j, d] = -own * pull[(j + d) % ring]
            total += lower[j, d] * inverse[j, d]
        inverse[j, 0] = own * (own - total)
        here = j % ring
        for d in range(reach, -1, -1):
            there = (j + d) % ring
            near[here, there] = near[there, here] = inverse[j, d]
    return inverse.T


@njit(cache=True, nogil=True)
def cubic_weights(t: Floats, first: Ints) -> Floats:
    """The four cubic B-splines (n, 4) of the knot span `first` (n,) at `t` (n,), in knot spans."""
    out = np.empty((len(t), 4))
    for n in range(len(t)):
        _cubic(t[n] - first[n], out[n])
    return out


@njit(cache=True, nogil=True)
def _columns(arm: Floats, normal: Floats, height: float, out: Floats) -> None:
    """Growth (6,) of a distance with the shift x, y and turn of a section, and with their slopes."""
    out[0], out[1] = normal[0], normal[1]
    out[2] = normal[1] * arm[0] - normal[0] * arm[1]
    for c in range(3):
        out[3 + c] = out[c] * height


@njit(cache=True, nogil=True)
def band_misfit(u: Floats, v: Floats, rows: Floats, coefficients: Floats, free: Floats) -> Floats:
    """Signed distance (n,) of points from a tensor spline with the rigid columns `free` (6,).

    `rows` (n, 6): distance, arm x, y, normal x, y, height; `u`, `v` as in `tensor_sums`.
    """
    p, q = coefficients.shape
    out = np.empty(len(u))
    bu, bv, columns = np.empty(4), np.empty(4), np.empty(6)
    for n in range(len(u)):
        i0 = int(u[n])
        k0 = min(max(int(v[n]), 0), q - 4)
        _cubic(u[n] - i0, bu)
        _cubic(v[n] - k0, bv)
        _columns(rows[n, 1:3], rows[n, 3:5], rows[n, 5], columns)
        value = 0.0
        for c in range(6):
            value += columns[c] * free[c]
        for a in range(4):
            i = _wrap(i0 + a, p)
            for k in range(4):
                value += bu[a] * bv[k] * coefficients[i, k0 + k]
        out[n] = rows[n, 0] - value
    return out


@njit(cache=True, nogil=True)
def band_bins(
    u: Floats, v: Floats, rows: Floats, weight: Floats, shape: tuple[int, int], per_span: tuple[int, int]
) -> Floats:
    """Weighted means (k, 10) of the points in each bin that has any: u, v, weight, distance, six columns.

    `shape` (p, spans) of the spline, `per_span` bins in each knot span; `rows` as in `band_misfit`. What a
    bin blurs is of second order: half the spline's curvature times the variance of places in a bin.
    """
    across = shape[1] * per_span[1]
    sums = np.zeros((shape[0] * per_span[0] * across, 10))
    columns = np.empty(6)
    for n in range(len(u)):
        w = weight[n]
        if w == 0.0:
            continue
        _columns(rows[n, 1:3], rows[n, 3:5], rows[n, 5], columns)
        b = int(u[n] * per_span[0]) * across + min(max(int(v[n] * per_span[1]), 0), across - 1)
        sums[b, 0] += w * u[n]
        sums[b, 1] += w * v[n]
        sums[b, 2] += w
        sums[b, 3] += w * rows[n, 0]
        for c in range(6):
            sums[b, 4 + c] += w * columns[c]
    used = 0
    for b in range(len(sums)):
        total = sums[b, 2]
        if total > 0.0:
            for c in range(10):
                sums[used, c] = sums[b, c] if c == 2 else sums[b, c] / total
            used += 1
    return sums[:used].copy()


@njit(cache=True, nogil=True)
def sort_by_height(z_mm: Floats, mask: Bools, low_mm: float, step_mm: float, bins: int) -> tuple[Ints, Ints]:
    """The numbers of the points that `mask` does not mark, bin by bin upward, and where each bin begins.

    Bin b holds the heights from `low_mm` + b `step_mm` on; in a bin the points keep their order. Returns
    (k,) and (bins + 1,).
    """
    start = np.zeros(bins + 1, np.int64)
    for i in range(len(z_mm)):
        if not mask[i]:
            start[min(int((z_mm[i] - low_mm) / step_mm), bins - 1) + 1] += 1
    for b in range(bins):
        start[b + 1] += start[b]
    order, place = np.empty(start[bins], np.int64), start.copy()
    for i in range(len(z_mm)):
        if not mask[i]:
            b = min(int((z_mm[i] - low_mm) / step_mm), bins - 1)
            order[place[b]] = i
            place[b] += 1
    return order, start


@njit(cache=True, nogil=True)
def bend_times(along: Floats, values: Floats) -> Floats:
    """Symmetric periodic matrices (g, p, 4), [i, d] against i + d, none at 3, times (p, k): (g, p, k)."""
    groups, p, _ = along.shape
    out = np.zeros((groups, p, values.shape[1]))
    for g in range(groups):
        for i in range(p):
            for d in range(3):
                w = along[g, i, d]
                if w == 0.0:
                    continue
                j = _wrap(i + d, p)
                for k in range(values.shape[1]):
                    out[g, i, k] += w * values[j, k]
                    if d > 0:
                        out[g, j, k] += w * values[i, k]
    return out
