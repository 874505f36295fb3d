"""A closed triangle mesh asked from outside: where columns cross it, and its closest point."""

import numpy as np
from numba import njit

from geometry.types import Bools, Floats, Ints


@njit(cache=True, nogil=True)
def _left_of(ax: float, ay: float, bx: float, by: float, px: float, py: float) -> bool:
    """Whether p is left of a -> b; a tie falls the same way for both triangles at the edge."""
    if ax > bx or (ax == bx and ay > by):
        return not (ax - bx) * (py - by) - (ay - by) * (px - bx) >= 0.0
    return (bx - ax) * (py - ay) - (by - ay) * (px - ax) >= 0.0


@njit(cache=True, nogil=True)
def column_crossings(
    triangles_mm: Floats, corner_mm: Floats, pitch_mm: float, shape: tuple[int, int]
) -> tuple[Ints, Floats]:
    """Where columns parallel to z cross the mesh: `start` (columns + 1,) into the heights, ascending in each.

    Column (i, j) stands at corner + pitch * (i, j) and has number i * shape[1] + j. A closed mesh gives
    every column an even number of crossings: enter, leave, enter, leave.
    """
    count = np.zeros(shape[0] * shape[1] + 1, np.int64)
    start = np.zeros(1, np.int64)
    height = np.zeros(0)
    for fill in range(2):
        if fill:
            start = np.cumsum(count)
            height = np.zeros(start[-1])
            count[:] = 0
        for t in range(len(triangles_mm)):
            a, b, c = triangles_mm[t, 0], triangles_mm[t, 1], triangles_mm[t, 2]
            i0 = max(0, int(np.ceil((min(a[0], b[0], c[0]) - corner_mm[0]) / pitch_mm)))
            i1 = min(shape[0] - 1, int(np.floor((max(a[0], b[0], c[0]) - corner_mm[0]) / pitch_mm)))
            j0 = max(0, int(np.ceil((min(a[1], b[1], c[1]) - corner_mm[1]) / pitch_mm)))
            j1 = min(shape[1] - 1, int(np.floor((max(a[1], b[1], c[1]) - corner_mm[1]) / pitch_mm)))
            for i in range(i0, i1 + 1):
                x = corner_mm[0] + pitch_mm * i
                for j in range(j0, j1 + 1):
                    y = corner_mm[1] + pitch_mm * j
                    left = _left_of(a[0], a[1], b[0], b[1], x, y)
                    if _left_of(b[0], b[1], c[0], c[1], x, y) != left:
                        continue
                    if _left_of(c[0], c[1], a[0], a[1], x, y) != left:
                        continue
                    column = i * shape[1] + j
                    if fill:
                        wb = (x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])
                        wc = (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])
                        whole = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
                        z = a[2] + (wb * (b[2] - a[2]) + wc * (c[2] - a[2])) / whole
                        height[start[column] + count[column + 1]] = z
                    count[column + 1] += 1
    for column in range(len(start) - 1):
        height[start[column] : start[column + 1]].sort()
    return start, height


@njit(cache=True, nogil=True)
def nodes_inside(
    start: Ints, height_mm: Floats, z0_mm: float, step_mm: float, shape: tuple[int, int, int]
) -> Bools:
    """Which nodes of a grid of `shape` lie inside the mesh whose columns `column_crossings` gave."""
    inside = np.zeros(shape, np.bool_)
    for i in range(shape[0]):
        for j in range(shape[1]):
            column = i * shape[1] + j
            for c in range(start[column], start[column + 1] - 1, 2):
                k0 = max(0, int(np.ceil((height_mm[c] - z0_mm) / step_mm)))
                k1 = min(shape[2] - 1, int(np.floor((height_mm[c + 1] - z0_mm) / step_mm)))
                for k in range(k0, k1 + 1):
                    inside[i, j, k] = True
    return inside


@njit(cache=True, nogil=True)
def triangle_cells(
    triangles_mm: Floats, origin_mm: Floats, cell_mm: float, shape: tuple[int, int, int]
) -> tuple[Ints, Ints]:
    """Triangles by the cells that their boxes touch: `start` (cells + 1,) into `member`."""
    count = np.zeros(shape[0] * shape[1] * shape[2] + 1, np.int64)
    start = np.zeros(1, np.int64)
    member = np.zeros(0, np.int64)
    low = np.zeros(3, np.int64)
    high = np.zeros(3, np.int64)
    for fill in range(2):
        if fill:
            start = np.cumsum(count)
            member = np.zeros(start[-1], np.int64)
            count[:] = 0
        for t in range(len(triangles_mm)):
            for axis in range(3):
                edge = triangles_mm[t, :, axis] - origin_mm[axis]
                low[axis] = min(max(int(np.floor(edge.min() / cell_mm)), 0), shape[axis] - 1)
                high[axis] = min(max(int(np.floor(edge.max() / cell_mm)), 0), shape[axis] - 1)
            for i in range(low[0], high[0] + 1):
                for j in range(low[1], high[1] + 1):
                    for k in range(low[2], high[2] + 1):
                        cell = (i * shape[1] + j) * shape[2] + k
                        if fill:
                            member[start[cell] + count[cell + 1]] = t
                        count[cell + 1] += 1
    return start, member


@njit(cache=True, nogil=True, inline="always")
def _nearest_weights(p, a, b, c):  # type: ignore[no-untyped-def]
    """Weights of b and c in the point of triangle abc nearest to p (Ericson, 2004, section 5.1.5)."""
    ab0, ab1, ab2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    ac0, ac1, ac2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    ap0, ap1, ap2 = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    bb, bc = ab0 * ab0 + ab1 * ab1 + ab2 * ab2, ab0 * ac0 + ab1 * ac1 + ab2 * ac2
    cc = ac0 * ac0 + ac1 * ac1 + ac2 * ac2
    d1, d2 = ab0 * ap0 + ab1 * ap1 + ab2 * ap2, ac0 * ap0 + ac1 * ap1 + ac2 * ap2
    d3, d4, d5, d6 = d1 - bb, d2 - bc, d1 - bc, d2 - cc
    if d1 <= 0.0 and d2 <= 0.0:
        return 0.0, 0.0
    if d3 >= 0.0 and d4 <= d3:
        return 1.0, 0.0
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 1.0
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return d1 / bb, 0.0
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return 0.0, d2 / cc
    if va <= 0.0 and d4 >= d3 and d5 >= d6:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 1.0 - t, t
    return vb / (va + vb + vc), vc / (va + vb + vc)


@njit(cache=True, nogil=True)
def closest_on_triangles(
    points_mm: Floats,
    triangles_mm: Floats,
    normals: Floats,
    start: Ints,
    member: Ints,
    origin_mm: Floats,
    cell_mm: float,
    shape: tuple[int, int, int],
) -> tuple[Floats, Floats, Ints]:
    """Signed distance (n,), positive outside, closest point (n, 3) and triangle (n,) of every point.

    `start`, `member`, `origin_mm`, `cell_mm`, `shape`: the cells of `triangle_cells`, which enclose the mesh.
    Where several triangles tie (an edge, a vertex) the sign is that of the one which the point faces most
    squarely: at a sharp edge the point may lie on the wrong side of the other one's plane.
    """
    distance = np.full(len(points_mm), np.inf)
    foot = np.zeros((len(points_mm), 3))
    face = np.full(len(points_mm), -1, np.int64)
    home = np.zeros(3, np.int64)
    for q in range(len(points_mm)):
        p = points_mm[q]
        for axis in range(3):
            home[axis] = min(max(int((p[axis] - origin_mm[axis]) / cell_mm), 0), shape[axis] - 1)
        inset = cell_mm  # of the point from the walls of its cell; negative outside the grid
        for axis in range(3):
            above = p[axis] - origin_mm[axis] - home[axis] * cell_mm
            inset = min(inset, above, cell_mm - above)
        best2, squarest = 1e300, 0.0
        for ring in range(max(shape) + 1):
            searched = inset + (ring - 1) * cell_mm
            if searched > 0.0 and best2 < searched * searched:
                break
            for i in range(max(home[0] - ring, 0), min(home[0] + ring, shape[0] - 1) + 1):
                for j in range(max(home[1] - ring, 0), min(home[1] + ring, shape[1] - 1) + 1):
                    shell = abs(i - home[0]) == ring or abs(j - home[1]) == ring
                    for k in range(max(home[2] - ring, 0), min(home[2] + ring, shape[2] - 1) + 1):
                        if not shell and abs(k - home[2]) != ring:
                            continue
                        cell = (i * shape[1] + j) * shape[2] + k
                        for m in range(start[cell], start[cell + 1]):
                            t = member[m]
                            a, b, c = triangles_mm[t, 0], triangles_mm[t, 1], triangles_mm[t, 2]
                            v, w = _nearest_weights(p, a, b, c)
                            x = a[0] + v * (b[0] - a[0]) + w * (c[0] - a[0])
                            y = a[1] + v * (b[1] - a[1]) + w * (c[1] - a[1])
                            z = a[2] + v * (b[2] - a[2]) + w * (c[2] - a[2])
                            dx, dy, dz = p[0] - x, p[1] - y, p[2] - z
                            d2 = dx * dx + dy * dy + dz * dz
                            tie = 1e-12 * (1.0 + best2)
                            if d2 > best2 + tie:
                                continue
                            square = dx * normals[t, 0] + dy * normals[t, 1] + dz * normals[t, 2]
                            if d2 < best2 - tie or abs(square) > abs(squarest):
                                squarest = square
                                face[q] = t
                                foot[q, 0], foot[q, 1], foot[q, 2] = x, y, z
                            best2 = min(best2, d2)
        distance[q] = np.sqrt(best2) if squarest >= 0.0 else -np.sqrt(best2)
    return distance, foot, face
