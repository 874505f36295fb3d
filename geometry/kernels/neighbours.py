"""All k nearest neighbours of a cloud by one cell-sorted list: exact, and kinder to the cache than a tree."""

import numpy as np
from numba import njit

from geometry.kernels.parts import over_parts
from geometry.types import Floats, Ints

AXIS_BITS = 21  # of a key, for each axis: cells are numbered x before y before z
AXIS_MASK = (1 << AXIS_BITS) - 1
ROWS = np.array([(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0), (-1, -1), (-1, 1), (1, -1), (1, 1)])  # x, y
SAMPLE = 20_000  # points that tell how dense a cloud is
CROWDED = 16  # of them in a cell: too coarse a look
WIDER = 1.3  # than the k nearest reach in the mean
LARGEST = np.iinfo(np.int64).max
NEAR_MM = 2.0  # cells of points that are asked together
TURNS = 64  # of such cells, on each axis, until they take turns with the first again


def k_nearest(points_mm: Floats, k: int) -> tuple[Ints, Floats]:
    """Indices (n, k) and distances (n, k) of the k nearest points of each point, itself first, ascending.

    Exact. Raises `ValueError` unless 1 <= k <= n.
    """
    order, nearest, apart_mm = sorted_nearest(points_mm, k)
    indices, distances_mm = np.empty_like(nearest), np.empty_like(apart_mm)
    indices[order], distances_mm[order] = order[nearest], apart_mm
    return indices, distances_mm


def sorted_nearest(points_mm: Floats, k: int) -> tuple[Ints, Ints, Floats]:
    """An order (n,) of the points, cell by cell, and the k nearest (n, k) of the points so ordered.

    Indices and distances are those of `k_nearest(points_mm[order], k)`.
    """
    count = len(points_mm)
    if not 1 <= k <= count:
        raise ValueError(f"k = {k} neighbours asked of {count} points")
    low_mm, cell_mm = points_mm.min(axis=0), _cell_size(points_mm, k)
    keys = cell_keys(points_mm, low_mm, cell_mm)
    order = np.argsort(keys, kind="stable")
    sorted_mm, keys = points_mm[order], keys[order]
    nearest, distances_mm = np.empty((count, k), np.int64), np.empty((count, k))
    known = (sorted_mm, keys, low_mm, cell_mm, nearest, distances_mm)
    over_parts(lambda first, last: nearest_in_cells(*known, first, last), count)
    return order, nearest, distances_mm


def _cell_size(points_mm: Floats, k: int) -> float:
    """The edge of a cell a little wider than the k nearest of a point of a surface reach: one that has to be
    searched for by itself costs as much as twenty others."""
    sample_mm = points_mm[:: max(1, len(points_mm) // SAMPLE)]
    low_mm = points_mm.min(axis=0)
    extent_mm = max(float((points_mm.max(axis=0) - low_mm).max()), 1e-9)
    probe_mm, finest_mm = extent_mm / 64.0, extent_mm / (AXIS_MASK - 2)
    while True:
        occupied = len(np.unique(cell_keys(sample_mm, low_mm, probe_mm)))
        if occupied * CROWDED >= len(sample_mm) or probe_mm <= 2.0 * finest_mm:
            break
        probe_mm *= 0.5
    reach_mm = probe_mm * float(np.sqrt(occupied * k / (np.pi * len(points_mm))))
    return max(WIDER * reach_mm, finest_mm)


@njit(cache=True, nogil=True)
def cell_keys(points: Floats, low: Floats, cell: float) -> Ints:
    """The number (n,) of the cell of each point (n, 3), in a grid of edge `cell` from `low`."""
    keys = np.empty(len(points), np.int64)
    for i in range(len(points)):
        key = 0
        for axis in range(3):
            key = (key << AXIS_BITS) | int((points[i, axis] - low[axis]) / cell)
        keys[i] = key
    return keys


@njit(cache=True, nogil=True)
def _first_from(keys: Ints, key: int, low: int) -> int:
    """The first place from `low` on whose key is at least `key`, in ascending keys."""
    high = len(keys)
    while low < high:
        middle = (low + high) >> 1
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, nogil=True)
def nearest_in_cells(
    points: Floats,
    keys: Ints,
    low: Floats,
    cell: float,
    indices: Ints,
    distances: Floats,
    first: int,
    last: int,
) -> None:
    """Write the k nearest of every point whose cell begins from `first` to before `last`.

    The points are sorted by their cells' `keys`; `indices` (n, k) and `distances` (n, k) are written. The
    points of a cell share what lies in its 27 cells. A point that has fewer than k of it nearer than
    anything outside can be is searched for by itself.
    """
    count, k = indices.shape
    start, stop = np.zeros(len(ROWS), np.int64), np.zeros(len(ROWS), np.int64)
    near, near2 = np.empty(k, np.int64), np.empty(k)
    around, places, apart2, ranks = room_for(64)
    end = first
    while 0 < end < count and keys[end] == keys[end - 1]:
        end += 1
    while end < last:
        begin, key = end, keys[end]
        while end < count and keys[end] == key:
            end += 1
        found = _find_rows(keys, key, start, stop)
        if found > len(around):
            around, places, apart2, ranks = room_for(2 * found)
        found = 0
        for r in range(len(start)):
            for j in range(start[r], stop[r]):
                around[found] = j
                for axis in range(3):
                    places[axis, found] = points[j, axis]
                found += 1
        for i in range(begin, end):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            for j in range(found):
                dx, dy, dz = places[0, j] - x, places[1, j] - y, places[2, j] - z
                apart2[j] = dx * dx + dy * dy + dz * dz
            reach = cell + _margin_in(x, y, z, low, cell, key)
            if found < k or not choose(around, apart2, ranks, found, near, near2) <= reach * reach:
                _search_far(points, keys, low, cell, i, near, near2)
            _keep(near, near2, i, indices[i], distances[i])


@njit(cache=True, nogil=True)
def room_for(most: int) -> tuple[Ints, Floats, Floats, Ints]:
    """Empty arrays for so many candidates: indices (m,), places (6, m), squared distances and ranks (m,)."""
    return np.empty(most, np.int64), np.empty((6, most)), np.empty(most), np.empty(most, np.int64)


@njit(cache=True, nogil=True)
def choose(around: Ints, apart2: Floats, ranks: Ints, found: int, near: Ints, near2: Floats) -> float:
    """Fill `near` and `near2` (k,) with the nearest of the first `found` of `around`, ascending, and return
    the last one's squared distance.

    A rank is the bits of a squared distance, which order as it does, the last few of them the candidate's
    number: the least rank above the last taken is found without a branch, many at a time, which is several
    times faster than a list kept in order. Where two distances agree to a part in a billion, the first counts
    as the nearer.
    """
    number = 15
    while number < found:
        number = 2 * number + 1
    bits = apart2.view(np.int64)
    for j in range(found):
        ranks[j] = (bits[j] & ~number) | j
    last = -1
    for t in range(len(near)):
        least = LARGEST
        for j in range(found):
            rank = ranks[j]
            least = min(least, rank if rank > last else LARGEST)
        last, j = least, least & number
        d2, place = apart2[j], t
        while place > 0 and near2[place - 1] > d2:
            near[place], near2[place] = near[place - 1], near2[place - 1]
            place -= 1
        near[place], near2[place] = around[j], d2
    return float(near2[-1])


@njit(cache=True, nogil=True, inline="always")
def _find_rows(keys, key, start, stop):  # type: ignore[no-untyped-def]
    """How many points the cells around that of `key` hold: in rows of three along z, `start` to `stop`.

    Both only move on from where they stood for the last key.
    """
    x, y, z = key >> (2 * AXIS_BITS), (key >> AXIS_BITS) & AXIS_MASK, key & AXIS_MASK
    found = 0
    for r in range(len(ROWS)):
        a, b = x + ROWS[r, 0], y + ROWS[r, 1]
        first, last = start[r], max(start[r], stop[r])
        if a >= 0 and b >= 0:
            row = ((a << AXIS_BITS) | b) << AXIS_BITS
            while first < len(keys) and keys[first] < row + max(z - 1, 0):
                first += 1
            last = max(first, last)
            while last < len(keys) and keys[last] <= row + z + 1:
                last += 1
            found += last - first
        else:
            last = first
        start[r], stop[r] = first, last
    return found


@njit(cache=True, nogil=True, inline="always")
def insert(near, near2, j, d2, k):  # type: ignore[no-untyped-def]
    """Point j at squared distance d2 put in its place of the ascending list of k."""
    if d2 < near2[k - 1]:
        t = k - 1
        while t > 0 and near2[t - 1] > d2:
            near[t], near2[t] = near[t - 1], near2[t - 1]
            t -= 1
        near[t], near2[t] = j, d2


@njit(cache=True, nogil=True)
def _keep(near: Ints, near2: Floats, i: int, indices: Ints, distances: Floats) -> None:
    """The list of point i as indices and distances, the point itself before its duplicates."""
    ahead = near[0]
    for j in range(len(near)):
        indices[j] = ahead if near[j] == i else near[j]
        distances[j] = np.sqrt(near2[j])
    indices[0] = i


@njit(cache=True, nogil=True)
def _search_far(
    points: Floats, keys: Ints, low: Floats, cell: float, i: int, near: Ints, near2: Floats
) -> None:
    """The nearest of point i in ever larger boxes of cells, until nothing nearer can be outside."""
    key, shell, k = keys[i], 2, len(near)
    x, y, z = key >> (2 * AXIS_BITS), (key >> AXIS_BITS) & AXIS_MASK, key & AXIS_MASK
    inside = _margin_in(points[i, 0], points[i, 1], points[i, 2], low, cell, key)
    while True:
        near2[:] = np.inf
        _scan_box(points, keys, x, y, z, shell, i, near, near2)
        reach = shell * cell + inside
        if near2[k - 1] <= reach * reach:
            return
        shell += (shell + 1) // 2


@njit(cache=True, nogil=True)
def _scan_box(
    points: Floats, keys: Ints, x: int, y: int, z: int, shell: int, i: int, near: Ints, near2: Floats
) -> None:
    """Insert what lies at most `shell` cells off, leaping over what does not."""
    y0, z0 = max(y - shell, 0), max(z - shell, 0)
    j = _first_from(keys, (((max(x - shell, 0) << AXIS_BITS) | y0) << AXIS_BITS) | z0, 0)
    while j < len(keys):
        a, b, c = keys[j] >> (2 * AXIS_BITS), (keys[j] >> AXIS_BITS) & AXIS_MASK, keys[j] & AXIS_MASK
        if a > x + shell:
            return
        if b > y + shell:
            a, b, c = a + 1, y0, z0
        elif b < y0:
            b, c = y0, z0
        elif c > z + shell:
            b, c = b + 1, z0
        elif c < z0:
            c = z0
        else:
            dx, dy, dz = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
            insert(near, near2, j, dx * dx + dy * dy + dz * dz, len(near))
            j += 1
            continue
        j = _first_from(keys, (((a << AXIS_BITS) | b) << AXIS_BITS) | c, j)


@njit(cache=True, nogil=True, inline="always")
def _margin_in(x, y, z, low, cell, key):  # type: ignore[no-untyped-def]
    a, b, c = key >> (2 * AXIS_BITS), (key >> AXIS_BITS) & AXIS_MASK, key & AXIS_MASK
    return margin(x, y, z, low, cell, a, b, c)


@njit(cache=True, nogil=True, inline="always")
def margin(x, y, z, low, cell, a, b, c):  # type: ignore[no-untyped-def]
    """Distance from the point to the nearest wall of its own cell."""
    x, y, z = x - low[0] - a * cell, y - low[1] - b * cell, z - low[2] - c * cell
    return max(min(x, cell - x, y, cell - y, z, cell - z), 0.0)


def cell_index(points_mm: Floats, low_mm: Floats, cell_mm: float, cells: Ints) -> Ints:
    """The cell (n,) of each point (n, 3) in a grid, that at its rim for a point outside."""
    cell = np.clip(((points_mm - low_mm) / cell_mm).astype(np.int64), 0, cells - 1)
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


@njit(cache=True, nogil=True)
def near_each_other(points_mm: Floats) -> Ints:
    """An order (n,) in which the points of one cell follow each other: a tree that is asked so answers twice
    as fast. Cells 64 apart take turns, so that a stray point costs nothing."""
    keys = np.empty(len(points_mm), np.int64)
    for i in range(len(points_mm)):
        key = 0
        for axis in range(3):
            key = key * TURNS + int(np.floor(points_mm[i, axis] / NEAR_MM)) % TURNS
        keys[i] = key
    return counting_sort(keys, TURNS**3)[1]
