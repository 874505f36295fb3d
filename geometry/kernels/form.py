"""Smooth motions fitted round nodes of a surface, and blended between them."""

import numpy as np
from numba import njit

from geometry.kernels.neighbours import insert, margin
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
    rows, closeness, weights, residual = np.empty((k, MOTIONS)), np.empty(k), np.empty(k), np.empty(k)
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
            design[:], right[:] = 0.0, 0.0
            for j in range(k):
                value = values[members[i, j]]
                for a in range(MOTIONS):
                    weighted = weights[j] * rows[j, a]
                    right[a] += weighted * value
                    for b in range(a + 1):
                        design[a, b] += weighted * rows[j, b]
            for a in range(MOTIONS):
                design[a, a] += ridge * k
            cholesky_solve(design, right)
            for j in range(k):
                fitted = 0.0
                for a in range(MOTIONS):
                    fitted += rows[j, a] * right[a]
                residual[j] = abs(values[members[i, j]] - fitted)
            scale = TUKEY * max(NORMAL * np.median(residual), 1e-6)
            for j in range(k):
                weights[j] = closeness[j] * max(1.0 - (residual[j] / scale) ** 2, 0.0) ** 2
        fits[i] = right
    return fits


@njit(cache=True, nogil=True)
def blend(
    points: Floats,
    normals: Floats,
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
    """The fits at each point (n,), weighted by closeness over its `nearest` nodes.

    A unit of normal counts as `turn` of distance. `order` and `starts` sort the nodes into a grid of
    `cells` of edge `cell` from `low`; shells of cells are searched until no nearer node can be outside.
    """
    values = np.empty(len(points))
    near2, near, row = np.empty(nearest), np.empty(nearest, np.int64), np.empty(MOTIONS)
    grid = (order, starts, low, cell, cells)
    for i in range(len(points)):
        _closest_nodes(points[i], normals[i], nodes, node_normals, turn, grid, near, near2)
        widest = (1.05 * np.sqrt(near2[nearest - 1]) + 1e-9) ** 2
        total, value = 0.0, 0.0
        for t in range(nearest):
            q = near[t]
            weight = max(1.0 - near2[t] / widest, 0.0) ** 2
            x, y, z = (
                points[i, 0] - nodes[q, 0],
                points[i, 1] - nodes[q, 1],
                points[i, 2] - nodes[q, 2],
            )
            _row(row, x, y, z, normals[i])
            for a in range(MOTIONS):
                value += weight * row[a] * fits[q, a]
            total += weight
        values[i] = value / total
    return values


@njit(cache=True, nogil=True)
def _closest_nodes(point, normal, nodes, node_normals, turn, grid, near, near2):  # type: ignore[no-untyped-def]
    """Fill `near` and `near2` (k,) with the k closest nodes and their squared distances, ascending."""
    order, starts, low, cell, cells = grid
    k = len(near)
    near2[:] = np.inf
    at = np.empty(3, np.int64)
    for axis in range(3):
        at[axis] = min(max(int((point[axis] - low[axis]) / cell), 0), cells[axis] - 1)
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
