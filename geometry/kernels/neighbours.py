"""All k nearest neighbours of a cloud by one cell-sorted grid: exact, and kinder to the cache than a tree."""

import numpy as np
from numba import njit

from geometry.types import Floats, Ints

MAX_CELLS = 1 << 24  # the cell grows until the grid fits


def k_nearest(points_mm: Floats, k: int) -> tuple[Ints, Floats]:
    """Indices (n, k) and distances (n, k) of the k nearest points of each point, itself first, ascending.

    Exact. Raises `ValueError` unless 1 <= k <= n.
    """
    count = len(points_mm)
    if not 1 <= k <= count:
        raise ValueError(f"k = {k} neighbours asked of {count} points")
    low_mm, cell_mm, cells, starts, order = _grid(points_mm, k)
    indices, distances_mm = nearest_in_grid(points_mm[order], order, starts, low_mm, cell_mm, cells, k)
    return indices, distances_mm


def in_cell_order(points_mm: Floats) -> Ints:
    """An order (n,) in which neighbours follow each other: what walks the points so stays in the cache."""
    *_, order = _grid(points_mm, 12)
    return order


def _grid(points_mm: Floats, k: int) -> tuple[Floats, float, Ints, Ints, Ints]:
    low_mm = points_mm.min(axis=0)
    cell_mm = _cell_size(points_mm, low_mm, k)
    cells = ((points_mm.max(axis=0) - low_mm) / cell_mm).astype(np.int64) + 1
    starts, order = counting_sort(cell_index(points_mm, low_mm, cell_mm, cells), int(cells.prod()))
    return low_mm, cell_mm, cells, starts, order


def _cell_size(points_mm: Floats, low_mm: Floats, k: int) -> float:
    """The edge of a cell that holds about k/2 points where there are any: surfaces fill few cells."""
    extent_mm = np.maximum(points_mm.max(axis=0) - low_mm, 1e-9)
    sample = points_mm[:: max(1, len(points_mm) // 20000)]
    probe_mm = float(extent_mm.max()) / 64.0
    occupied = len(np.unique(((sample - low_mm) / probe_mm).astype(np.int64) @ (1, 65, 65 * 65)))
    area_mm2 = occupied * probe_mm * probe_mm
    cell_mm = 0.85 * float(np.sqrt(area_mm2 * k / (np.pi * len(points_mm))))
    while float(np.prod(np.floor(extent_mm / cell_mm) + 1.0)) > MAX_CELLS:
        cell_mm *= 1.26
    return cell_mm


def cell_index(points_mm: Floats, low_mm: Floats, cell_mm: float, cells: Ints) -> Ints:
    cell = np.minimum(((points_mm - low_mm) / cell_mm).astype(np.int64), cells - 1)
    return np.asarray((cell[:, 0] * cells[1] + cell[:, 1]) * cells[2] + cell[:, 2])


@njit(cache=True, nogil=True)
def counting_sort(keys: Ints, bins: int) -> tuple[Ints, Ints]:
    """Starts (bins + 1,) of each key's run and the stable order (n,) that sorts the keys."""
    starts = np.zeros(bins + 1, np.int64)
    for key in keys:
        starts[key + 1] += 1
    for b in range(bins):
        starts[b + 1] += starts[b]
    cursor = starts[:-1].copy()
    order = np.empty(len(keys), np.int64)
    for i in range(len(keys)):
        order[cursor[keys[i]]] = i
        cursor[keys[i]] += 1
    return starts, order


@njit(cache=True, nogil=True, inline="always")
def _scan(sorted_points, first, last, i, near2, near):  # type: ignore[no-untyped-def]
    """Insert the points first..last but i into the ascending list of those nearest to point i."""
    x, y, z = sorted_points[i, 0], sorted_points[i, 1], sorted_points[i, 2]
    k = len(near2)
    for j in range(first, last):
        if j == i:
            continue
        dx, dy, dz = sorted_points[j, 0] - x, sorted_points[j, 1] - y, sorted_points[j, 2] - z
        d2 = dx * dx + dy * dy + dz * dz
        if d2 < near2[k - 1]:
            t = k - 1
            while t > 0 and near2[t - 1] > d2:
                near2[t] = near2[t - 1]
                near[t] = near[t - 1]
                t -= 1
            near2[t] = d2
            near[t] = j


@njit(cache=True, nogil=True)
def nearest_in_grid(
    sorted_points: Floats, order: Ints, starts: Ints, low: Floats, cell: float, cells: Ints, k: int
) -> tuple[Ints, Floats]:
    """The k nearest of every point, searching growing shells of cells until nothing nearer can be outside.

    `sorted_points` are the points in cell order, `order` maps them back, `starts` are the cells' runs.
    """
    count = len(sorted_points)
    nx, ny, nz = cells[0], cells[1], cells[2]
    indices = np.empty((count, k), np.int64)
    distances = np.empty((count, k))
    near2 = np.empty(k)
    near = np.empty(k, np.int64)
    for i in range(count):
        x, y, z = sorted_points[i, 0], sorted_points[i, 1], sorted_points[i, 2]
        a = min(int((x - low[0]) / cell), nx - 1)
        b = min(int((y - low[1]) / cell), ny - 1)
        c = min(int((z - low[2]) / cell), nz - 1)
        near2[:] = np.inf
        near2[0] = -1.0  # the point itself stays first, before its duplicates
        near[0] = i
        if k > 1:
            shell = 0
            inside = margin(x, y, z, low, cell, a, b, c)
            while shell <= max(nx, ny, nz):
                c0, c1 = c - shell, c + shell
                first, last = max(0, c0), min(nz - 1, c1)
                for ia in range(max(0, a - shell), min(nx - 1, a + shell) + 1):
                    for ib in range(max(0, b - shell), min(ny - 1, b + shell) + 1):
                        row = starts[(ia * ny + ib) * nz : (ia * ny + ib + 1) * nz + 1]
                        if abs(ia - a) == shell or abs(ib - b) == shell:
                            _scan(sorted_points, row[first], row[last + 1], i, near2, near)
                            continue
                        if c0 >= 0:
                            _scan(sorted_points, row[c0], row[c0 + 1], i, near2, near)
                        if c1 < nz:
                            _scan(sorted_points, row[c1], row[c1 + 1], i, near2, near)
                reach = shell * cell + inside
                if near2[k - 1] <= reach * reach:
                    break
                shell += 1
        at = order[i]
        for t in range(k):
            indices[at, t] = order[near[t]]
            distances[at, t] = np.sqrt(max(near2[t], 0.0))
    return indices, distances


@njit(cache=True, nogil=True, inline="always")
def margin(x, y, z, low, cell, a, b, c):  # type: ignore[no-untyped-def]
    """Distance from the point to the nearest wall of its own cell."""
    x, y, z = x - low[0] - a * cell, y - low[1] - b * cell, z - low[2] - c * cell
    return max(min(x, cell - x, y, cell - y, z, cell - z), 0.0)
