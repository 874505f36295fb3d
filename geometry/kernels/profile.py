"""Points sorted by height, and their projection on stacked section curves."""

import math

import numpy as np
from numba import njit

from geometry.types import Bools, Floats, Ints


@njit(cache=True, nogil=True)
def wrap(j: int, m: int) -> int:
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
    px, py = _node(curves, three, up, wrap(j + 1, m))
    ex, ey = px - nx, py - ny
    jump = round(((x - nx) * ex + (y - ny) * ey) / (ex * ex + ey * ey + 1e-300))
    if jump != 0:
        k = wrap(j + min(max(jump, -40), 40), m)
        nx, ny = _node(curves, three, up, k)
        d2 = (nx - x) ** 2 + (ny - y) ** 2
        if d2 < best:
            j, best = k, d2
    stride = 4
    while stride >= 1:
        for direction in (stride, -stride):
            while True:
                k = wrap(j + direction, m)
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
    lx, ly = _node(curves, three, up, wrap(j - 1, m))
    rx, ry = _node(curves, three, up, wrap(j + 1, m))
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
                k = wrap(j + direction, m)
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
