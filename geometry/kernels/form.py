"""Smooth motions fitted round nodes of a surface, and blended between them."""

import numpy as np
from numba import njit

from geometry.kernels.neighbours import choose, insert, margin, room_for
from geometry.kernels.quadric import cholesky_solve
from geometry.robust import NORMAL, TUKEY
from geometry.types import Floats, Ints

MOTIONS = 10  # shifts, turns, thickening and its slope


@njit(cache=True, nogil=True, inline="always")
def _row(row, x, y, z, normal):  # type: ignore[no-untyped-def]
    """What each smooth motion moves a point at (x, y, z) from its node along the normal there."""
    nx, ny, nz = normal[0], normal[1], normal[2]
    row[0], row[1], row[2] = nx, ny, nz
    row[3], row[4], row[5] = y * nz - z * ny, z * nx - x * nz, x * ny - y * nx
    row[6], row[7], row[8], row[9] = 1.0, x, y, z


@njit(cache=True, nogil=True)
def local_fits(
    nodes: Floats, members: Ints, points: Floats, normals: Floats, values: Floats, steps: int, ridge: float
) -> Floats:
    """The smooth motion (m, 10) round each node (m, 3): least squares over its `members` (m, k).

    Members count by closeness, the last at three sigmas, and by Tukey's weights of `steps` reweightings.
    `ridge`, a share of k, steadies the motions that a flat surface does not tell.
    """
    count, k = members.shape
    fits = np.empty((count, MOTIONS))
    design, right = np.empty((MOTIONS, MOTIONS)), np.empty(MOTIONS)
    rows, weighted = np.empty((k, MOTIONS)), np.empty((k, MOTIONS))
    right_of, fitted, residual = np.empty(k), np.empty(k), np.empty(k)
    closeness, weights = np.empty(k), np.empty(k)
    for i in range(count):
        farthest2 = 1e-300
        for j in range(k):
            q = members[i, j]
            x, y, z = (
                points[q, 0] - nodes[i, 0],
                points[q, 1] - nodes[i, 1],
                points[q, 2] - nodes[i, 2],
            )
            _row(rows[j], x, y, z, normals[q])
            closeness[j] = x * x + y * y + z * z
            farthest2 = max(farthest2, closeness[j])
        for j in range(k):
            closeness[j] = np.exp(-4.5 * closeness[j] / farthest2)
            weights[j] = closeness[j]
        for _ in range(steps):
            for j in range(k):
                right_of[j] = values[members[i, j]]
                for a in range(MOTIONS):
                    weighted[j, a] = weights[j] * rows[j, a]
            np.dot(weighted.T, rows, design)
            np.dot(weighted.T, right_of, right)
            for a in range(MOTIONS):
                design[a, a] += ridge * k
            cholesky_solve(design, right)
            np.dot(rows, right, fitted)
            for j in range(k):
                residual[j] = abs(right_of[j] - fitted[j])
            scale = TUKEY * max(NORMAL * np.median(residual), 1e-6)
            for j in range(k):
                weights[j] = closeness[j] * max(1.0 - (residual[j] / scale) ** 2, 0.0) ** 2
        fits[i] = right
    return fits


@njit(cache=True, nogil=True)
def blend(
    points: Floats,
    normals: Floats,
    visit: Ints,
    nodes: Floats,
    node_normals: Floats,
    fits: Floats,
    nearest: int,
    turn: float,
    order: Ints,
    starts: Ints,
    low: Floats,
    cell: float,
    cells: Ints,
) -> Floats:
    """The fits at each point of `visit` (n,), weighted by closeness over its `nearest` nodes.

    A unit of normal counts as `turn` of distance. `order` and `starts` sort the nodes into a grid of
    `cells` of edge `cell` from `low`. Points of one cell share what lies in the 27 cells around; where a
    nearer node can be outside, shells of cells are searched until none can. Quickest if `visit` goes cell by
    cell.
    """
    values = np.empty(len(visit))
    near2, near, row = np.empty(nearest), np.empty(nearest, np.int64), np.empty(MOTIONS)
    around, places, apart2, ranks = room_for(64)
    grid = (order, starts, low, cell, cells)
    at, last, found = np.empty(3, np.int64), np.full(3, -1), 0
    for t in range(len(visit)):
        i = visit[t]
        _cell_of(points[i], low, cell, cells, at)
        if at[0] != last[0] or at[1] != last[1] or at[2] != last[2]:
            last[:] = at
            found = _count(at, grid)
            if found > len(around):
                around, places, apart2, ranks = room_for(2 * found)
            _gather(at, nodes, node_normals, grid, around, places)
        _apart2(points[i], normals[i], places, turn, found, apart2)
        reach = cell + margin(points[i, 0], points[i, 1], points[i, 2], low, cell, at[0], at[1], at[2])
        if found < nearest or not choose(around, apart2, ranks, found, near, near2) <= reach * reach:
            _closest_nodes(points[i], normals[i], at, nodes, node_normals, turn, grid, near, near2)
        values[t] = _blended(points[i], normals[i], nodes, fits, near, near2, row)
    return values


@njit(cache=True, nogil=True, inline="always")
def _cell_of(point, low, cell, cells, at):  # type: ignore[no-untyped-def]
    for axis in range(3):
        at[axis] = min(max(int((point[axis] - low[axis]) / cell), 0), cells[axis] - 1)


@njit(cache=True, nogil=True, inline="always")
def _row_of(at, r, starts, cells):  # type: ignore[no-untyped-def]
    """Where row `r` (of nine, three cells each along the last axis) round cell `at` begins and ends."""
    a, b = at[0] + r // 3 - 1, at[1] + r % 3 - 1
    if not (0 <= a < cells[0] and 0 <= b < cells[1]):
        return 0, 0
    row = (a * cells[1] + b) * cells[2]
    return starts[row + max(at[2] - 1, 0)], starts[row + min(at[2] + 1, cells[2] - 1) + 1]


@njit(cache=True, nogil=True)
def _count(at, grid):  # type: ignore[no-untyped-def]
    """How many nodes the 27 cells round cell `at` hold."""
    _, starts, _, _, cells = grid
    found = 0
    for r in range(9):
        first, stop = _row_of(at, r, starts, cells)
        found += stop - first
    return found


@njit(cache=True, nogil=True)
def _gather(at, nodes, node_normals, grid, around, places):  # type: ignore[no-untyped-def]
    """Write these nodes, and in columns where they are and their normals."""
    order, starts, _, _, cells = grid
    found = 0
    for r in range(9):
        first, stop = _row_of(at, r, starts, cells)
        for j in range(first, stop):
            q = order[j]
            around[found] = q
            for axis in range(3):
                places[axis, found], places[3 + axis, found] = nodes[q, axis], node_normals[q, axis]
            found += 1


@njit(cache=True, nogil=True)
def _apart2(point: Floats, normal: Floats, places: Floats, turn: float, found: int, apart2: Floats) -> None:
    """Squared distances of a point from the first `found` places (6, m), a unit of normal for `turn`."""
    x, y, z = point[0], point[1], point[2]
    u, v, w = normal[0], normal[1], normal[2]
    for j in range(found):
        a, b, c = x - places[0, j], y - places[1, j], z - places[2, j]
        d, e, f = turn * (u - places[3, j]), turn * (v - places[4, j]), turn * (w - places[5, j])
        apart2[j] = a * a + b * b + c * c + d * d + e * e + f * f


@njit(cache=True, nogil=True, inline="always")
def _blended(point, normal, nodes, fits, near, near2, row):  # type: ignore[no-untyped-def]
    widest = (1.05 * np.sqrt(near2[-1]) + 1e-9) ** 2
    total, value = 0.0, 0.0
    for t in range(len(near)):
        q = near[t]
        weight = max(1.0 - near2[t] / widest, 0.0) ** 2
        _row(row, point[0] - nodes[q, 0], point[1] - nodes[q, 1], point[2] - nodes[q, 2], normal)
        for a in range(MOTIONS):
            value += weight * row[a] * fits[q, a]
        total += weight
    return value / total


@njit(cache=True, nogil=True)
def _closest_nodes(point, normal, at, nodes, node_normals, turn, grid, near, near2):  # type: ignore[no-untyped-def]
    """Fill `near` and `near2` (k,) with the k closest nodes and their squared distances, ascending."""
    order, starts, low, cell, cells = grid
    k = len(near)
    near2[:] = np.inf
    inside = margin(point[0], point[1], point[2], low, cell, at[0], at[1], at[2])
    for shell in range(max(cells[0], cells[1], cells[2]) + 1):
        for a in range(max(0, at[0] - shell), min(cells[0] - 1, at[0] + shell) + 1):
            for b in range(max(0, at[1] - shell), min(cells[1] - 1, at[1] + shell) + 1):
                rim = abs(a - at[0]) == shell or abs(b - at[1]) == shell
                for c in range(max(0, at[2] - shell), min(cells[2] - 1, at[2] + shell) + 1):
                    if not rim and abs(c - at[2]) != shell:
                        continue
                    key = (a * cells[1] + b) * cells[2] + c
                    for j in range(starts[key], starts[key + 1]):
                        q, away2 = order[j], 0.0
                        for axis in range(3):
                            d = point[axis] - nodes[q, axis]
                            away2 += d * d
                        if away2 >= near2[k - 1]:
                            continue
                        for axis in range(3):
                            e = turn * (normal[axis] - node_normals[q, axis])
                            away2 += e * e
                        insert(near, near2, q, away2, k)
        reach = shell * cell + inside
        if near2[k - 1] <= reach * reach:
            break
