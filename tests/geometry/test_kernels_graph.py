"""Flags on neighbour graphs against loops in Python."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from geometry.kernels.graph import component_sizes, dilate, grow, neighbourhood_mean, only_mutual


def random_graph(seed, count=200, k=3):
    rng = np.random.default_rng(seed)
    return rng.integers(-1, count, size=(count, k)), rng


def slow_grow(seed, allowed, neighbours):
    reached = set(np.flatnonzero(seed))
    while True:
        more = {q for i in reached for q in neighbours[i] if q >= 0 and allowed[q]} - reached
        if not more:
            return reached
        reached |= more


def test_growth_reaches_what_a_slow_search_reaches():
    neighbours, rng = random_graph(1)
    seed, allowed = rng.random(200) < 0.02, rng.random(200) < 0.4
    assert set(np.flatnonzero(grow(seed, allowed, neighbours))) == slow_grow(seed, allowed, neighbours)


def test_dilation_adds_exactly_the_neighbours():
    neighbours, rng = random_graph(2)
    flags = rng.random(200) < 0.1
    wanted = set(np.flatnonzero(flags)) | {q for i in np.flatnonzero(flags) for q in neighbours[i] if q >= 0}
    assert set(np.flatnonzero(dilate(flags, neighbours))) == wanted


def test_mean_counts_the_point_and_its_real_neighbours():
    neighbours, rng = random_graph(3)
    values = rng.normal(size=200)
    slow = [np.mean([values[i], *(values[q] for q in neighbours[i] if q >= 0)]) for i in range(200)]
    assert np.allclose(neighbourhood_mean(values, neighbours), slow)


def test_mutual_neighbours_name_each_other():
    neighbours, _ = random_graph(5, count=40, k=6)
    slow = [[q if q >= 0 and i in neighbours[q] else -1 for q in row] for i, row in enumerate(neighbours)]
    assert only_mutual(neighbours).tolist() == slow


def test_component_sizes_match_scipy():
    neighbours, _ = random_graph(4, k=1)
    rows = np.flatnonzero(neighbours[:, 0] >= 0)
    graph = coo_array((np.ones(len(rows)), (rows, neighbours[rows, 0])), shape=(200, 200))
    _, label = connected_components(graph, directed=False)
    assert (component_sizes(neighbours) == np.bincount(label)[label]).all()
