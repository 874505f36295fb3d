"""Points on stacked section curves: where they project, and what of them belongs to a profile."""

import math

import numpy as np
from numba import njit

from geometry.types import Floats, Ints


@njit(cache=True, nogil=True)
def wrap(j: int, m: int) -> int:
    """`j` in [0, m) for -m <= j < 2 m; a division is slower than all else that is done to a node."""
    if j >= m:
        return j - m
    return j + m if j < 0 else j


@njit(cache=True, nogil=True, inline="always")
def _node(curves: Floats, three: int, up: float, j: int) -> tuple[float, float]:
    """Node `j` of the curve at the fraction `up` of the interval `three`: a parabola in height.

    Unsigned numbers, so that none is tested for counting from the end.
    """
    t, n = np.uint64(three), np.uint64(j)
    x = curves[t, n, 0] + up * (curves[t, n, 2] + up * curves[t, n, 4])
    y = curves[t, n, 1] + up * (curves[t, n, 3] + up * curves[t, n, 5])
    return x, y


@njit(cache=True, nogil=True)
def _search(curves: Floats, three: int, up: float, x: float, y: float, starts: tuple[int, int]) -> int:
    """The nearest of the nodes that are reached step by step from two starts, the second perhaps -1."""
    m = curves.shape[1]
    nearest, least = 0, math.inf
    for start in starts:
        if start < 0:
            continue
        j = start
        nx, ny = _node(curves, three, up, j)
        best = (nx - x) ** 2 + (ny - y) ** 2
        stride = 4
        while stride >= 1:
            for direction in (stride, -stride):
                while True:
                    k = wrap(j + direction, m)
                    nx, ny = _node(curves, three, up, k)
                    d2 = (nx - x) ** 2 + (ny - y) ** 2
                    if not d2 < best:
                        break
                    j, best = k, d2
            stride //= 4
        if best < least:
            nearest, least = j, best
    return nearest


@njit(cache=True, nogil=True, inline="always")
def _slide(curves: Floats, three: int, up: float, x: float, y: float, start: int) -> tuple[int, float]:
    """The locally nearest node, or the one before it, by jumps along the tangent; distance^2.

    That is inf where they do not settle, as about an edge seen from inside.
    """
    m = curves.shape[1]
    j = start
    for _ in range(4):
        nx, ny = _node(curves, three, up, j)
        px, py = _node(curves, three, up, wrap(j + 1, m))
        ex, ey = px - nx, py - ny
        along = ((x - nx) * ex + (y - ny) * ey) / (ex * ex + ey * ey + 1e-300)
        if -0.5 <= along <= 1.0:
            return j, (nx - x) ** 2 + (ny - y) ** 2
        jump = along if abs(along) < 40.0 else math.copysign(40.0, along)
        j = wrap(j + math.floor(jump + 0.5), m)
    return j, math.inf


@njit(cache=True, nogil=True, inline="always")
def _on_segment(ax: float, ay: float, bx: float, by: float, x: float, y: float) -> tuple[float, float]:
    """The nearest place on a segment, as a fraction of it, and the distance^2 to there."""
    ex, ey = bx - ax, by - ay
    f = ((x - ax) * ex + (y - ay) * ey) / (ex * ex + ey * ey + 1e-300)
    f = min(1.0, max(0.0, f))
    return f, (x - ax - f * ex) ** 2 + (y - ay - f * ey) ** 2


@njit(cache=True, nogil=True, inline="always")
def _foot(
    curves: Floats, three: int, up: float, x: float, y: float, j: int
) -> tuple[float, float, float, float]:
    """Foot on the two segments that meet in node `j`: node coordinate, signed distance, outward normal."""
    m = curves.shape[1]
    cx, cy = _node(curves, three, up, j)
    lx, ly = _node(curves, three, up, wrap(j - 1, m))
    rx, ry = _node(curves, three, up, wrap(j + 1, m))
    before, low2 = _on_segment(lx, ly, cx, cy, x, y)
    after, high2 = _on_segment(cx, cy, rx, ry, x, y)
    if low2 < high2:
        f, best, foot = before, low2, j - 1 + before
        ax, ay, ex, ey = lx, ly, cx - lx, cy - ly
    else:
        f, best, foot = after, high2, j + after
        ax, ay, ex, ey = cx, cy, rx - cx, ry - cy
    fx, fy = ax + f * ex, ay + f * ey
    if foot == j:  # on the node itself: the mean normal decides inside and outside
        ex, ey = rx - lx, ry - ly
    length = math.sqrt(ex * ex + ey * ey) + 1e-300
    nx, ny = ey / length, -ex / length
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
    j, best = _slide(curves, three, up, x, y, seeds[cx, cy, 0])
    other = seeds[cx, cy, 1]
    if best == math.inf or (other >= 0 and 16.0 * best > across_mm[j] ** 2):
        j = _search(curves, three, up, x, y, (j, other))
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

    `curves` (k, m, 8) are counter-clockwise curves whose nodes correspond, one for each interval of height
    between the even ones of `z_mm` (2 k + 1,): x, y, their slope and their bend over the interval, and
    steepness (mm outward per mm of height) with its slope, NaN where the curve is not to be trusted.
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
    sigma_mm: Floats,
    motion: tuple[Floats, float, Floats, Floats],
    surface: tuple[Floats, Floats, Ints, Floats, Floats, float],
    limits: tuple[float, float],
) -> tuple[Floats, Floats, Floats, Floats]:
    """The points that belong to a profile, as what `band_misfit` takes of them.

    `motion` as `undo_motion` takes it, `surface` (`z_mm`, `curves`, `seeds`, `across_mm`, `corner_mm`,
    `cell_mm`) as `project` does. Points belong that lie within `limits` of the curve, where it is no
    steeper. Returns their node coordinate, height and sigma (k,), grown as a distance in the plane is
    longer than along the surface normal, and (k, 6) signed distance, arm x, y, outward normal x, y and
    height over the section.
    """
    pivot_mm, section_mm, rest, per_mm = motion
    z_mm, curves, seeds, across_mm, corner_mm, cell_mm = surface
    capture_mm, steepest = limits
    count = len(points_mm)
    node, heights_mm, sigmas_mm = np.empty(count), np.empty(count), np.empty(count)
    rows = np.empty((count, 6))
    used = 0
    for i in range(count):
        z = points_mm[i, 2]
        height = z - section_mm
        x, y = _undone(points_mm[i, 0], points_mm[i, 1], height, pivot_mm, rest, per_mm)
        three, up = _interval(z_mm, z)
        j = _nearest(curves, three, up, x, y, seeds, across_mm, corner_mm, cell_mm)
        foot, distance, nx, ny = _foot(curves, three, up, x, y, j)
        steep = curves[three, int(foot), 6] + up * curves[three, int(foot), 7]
        if abs(distance) <= capture_mm and abs(steep) <= steepest:
            node[used], heights_mm[used] = foot, z
            sigmas_mm[used] = sigma_mm[i] * math.sqrt(1.0 + steep * steep)
            rows[used, 0], rows[used, 3], rows[used, 4] = distance, nx, ny
            rows[used, 1], rows[used, 2] = x - pivot_mm[0], y - pivot_mm[1]
            rows[used, 5] = height
            used += 1
    return node[:used], heights_mm[:used], sigmas_mm[:used], rows[:used]
