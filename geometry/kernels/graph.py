"""Flags spread over a neighbour graph."""

import numpy as np
from numba import njit

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
def only_mutual(neighbours: Ints) -> Ints:
    """The neighbours (n, k) with -1 for each that does not have the point among its own."""
    mutual = np.full(neighbours.shape, -1, np.int64)
    for i in range(len(neighbours)):
        for j in range(neighbours.shape[1]):
            q = neighbours[i, j]
            if q < 0:
                continue
            for back in neighbours[q]:
                if back == i:
                    mutual[i, j] = q
                    break
    return mutual


@njit(cache=True, nogil=True)
def component_sizes(neighbours: Ints) -> Ints:
    """Size (n,) of the connected component of each point, edges taken both ways (n, k; -1 none)."""
    count = len(neighbours)
    parent = np.arange(count)
    for i in range(count):
        for q in neighbours[i]:
            if q >= 0:
                a, b = _root(parent, i), _root(parent, q)
                if a != b:
                    parent[max(a, b)] = min(a, b)
    size = np.zeros(count, np.int64)
    for i in range(count):
        size[_root(parent, i)] += 1
    for i in range(count):
        parent[i] = _root(parent, i)
    return size[parent]


@njit(cache=True, nogil=True, inline="always")
def _root(parent, i):  # type: ignore[no-untyped-def]
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i
