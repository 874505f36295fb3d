"""Flags spread over a neighbour graph."""

import numpy as np
from numba import njit

from geometry.kernels.neighbours import counting_sort
from geometry.types import Bools, Floats, Ints


@njit(cache=True, nogil=True)
def grow(seed: Bools, allowed: Bools, neighbours: Ints) -> Bools:
    """The seeds (n,) and every `allowed` point reached from them over `neighbours` (n, k; -1 none)."""
    reached = seed.copy()
    stack = np.empty(len(seed), np.int64)
    top = 0
    for i in range(len(seed)):
        if seed[i]:
            stack[top] = i
            top += 1
    while top > 0:
        top -= 1
        i = stack[top]
        for q in neighbours[i]:
            if q >= 0 and allowed[q] and not reached[q]:
                reached[q] = True
                stack[top] = q
                top += 1
    return reached


@njit(cache=True, nogil=True)
def dilate(flags: Bools, neighbours: Ints) -> Bools:
    """The flags (n,) and their neighbours (n, k; -1 none)."""
    wider = flags.copy()
    for i in range(len(flags)):
        if flags[i]:
            for q in neighbours[i]:
                if q >= 0:
                    wider[q] = True
    return wider


@njit(cache=True, nogil=True)
def neighbourhood_mean(values: Floats, neighbours: Ints) -> Floats:
    """Mean (n,) of each point's value and its neighbours' (n, k; -1 none)."""
    means = np.empty(len(values))
    for i in range(len(values)):
        total, found = values[i], 1
        for q in neighbours[i]:
            if q >= 0:
                total += values[q]
                found += 1
        means[i] = total / found
    return means


@njit(cache=True, nogil=True)
def neighbourhood_median(values: Floats, neighbours: Ints, wanted: Bools) -> Floats:
    """Median (n,) over the neighbours (n, k; -1 none) of each wanted point, NaN for the others."""
    medians = np.full(len(values), np.nan)
    members = np.empty(neighbours.shape[1])
    for i in range(len(values)):
        found = 0
        if wanted[i]:
            for q in neighbours[i]:
                if q >= 0:
                    members[found] = values[q]
                    found += 1
        if found > 0:
            medians[i] = np.median(members[:found])
    return medians


@njit(cache=True, nogil=True)
def group_medians(owner: Ints, values: Floats, size: int) -> tuple[Floats, Bools]:
    """Lower median (size,) of the values (n,) of each owner, and whether there are any; 0 without."""
    starts, order = counting_sort(owner, size)
    medians, some = np.zeros(size), np.zeros(size, np.bool_)
    for g in range(size):
        first, last = starts[g], starts[g + 1]
        if last > first:
            medians[g] = np.sort(values[order[first:last]])[(last - first - 1) // 2]
            some[g] = True
    return medians, some


@njit(cache=True, nogil=True)
def window_medians(values: Floats, variances: Floats, windows: Ints) -> tuple[Floats, Floats, Ints]:
    """Median (m,) of the values (n,) in each window, of which `windows` (2, m) holds first and end; the mean
    of their variances (n,), and how many there are. 0 where there are none."""
    medians, means = np.zeros(windows.shape[1]), np.zeros(windows.shape[1])
    for i in range(windows.shape[1]):
        first, end = windows[0, i], windows[1, i]
        if end > first:
            medians[i] = np.median(values[first:end])
            means[i] = variances[first:end].mean()
    return medians, means, windows[1] - windows[0]


@njit(cache=True, nogil=True)
def component_sizes(nearest: Ints, distances: Floats, width: int, reach: float) -> Ints:
    """Size (n,) of the connected component of each point.

    Two points are joined if they are at most `reach` apart and each is among the first `width` of the other's
    `nearest` (n, k), which have ascending `distances` (n, k).
    """
    count = len(nearest)
    parent = np.arange(count)
    for i in range(count):
        for j in range(width):
            q = nearest[i, j]
            if q <= i or distances[i, j] > reach:  # each pair once
                continue
            a, b = _root(parent, i), _root(parent, q)
            if a != b and _among(nearest, q, width, i):
                parent[max(a, b)] = min(a, b)
    size = np.zeros(count, np.int64)
    for i in range(count):
        parent[i] = _root(parent, i)
        size[parent[i]] += 1
    return size[parent]


@njit(cache=True, nogil=True, inline="always")
def _among(nearest, i, width, wanted):  # type: ignore[no-untyped-def]
    among = False
    for j in range(width):
        among = among or nearest[i, j] == wanted
    return among


@njit(cache=True, nogil=True, inline="always")
def _root(parent, i):  # type: ignore[no-untyped-def]
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i
