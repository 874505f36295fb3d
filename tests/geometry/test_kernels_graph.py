"""Flags on neighbour graphs against loops in Python."""

import numpy as np
from scipy.sparse.csgraph import connected_components

from geometry.kernels.graph import (
    component_sizes,
    dilate,
    group_medians,
    grow,
    neighbourhood_mean,
    neighbourhood_median,
    window_medians,
)


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


def test_median_is_that_of_the_real_neighbours_where_wanted():
    neighbours, rng = random_graph(6, k=4)
    values, wanted = rng.normal(size=200), rng.random(200) < 0.5
    slow = [
        np.median(values[row[row >= 0]]) if want and (row >= 0).any() else np.nan
        for row, want in zip(neighbours, wanted, strict=True)
    ]
    assert np.array_equal(neighbourhood_median(values, neighbours, wanted), slow, equal_nan=True)


def test_components_join_what_is_near_and_mutual():
    points = np.random.default_rng(5).uniform(0.0, 10.0, (150, 2))
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    nearest = np.argsort(apart, axis=1, kind="stable")[:, :6]
    distances = np.take_along_axis(apart, nearest, axis=1)
    named = np.zeros((150, 150), bool)
    np.put_along_axis(named, nearest[:, :4], True, axis=1)
    _, label = connected_components(named & named.T & (apart <= 0.9), directed=False)
    assert 10 < label.max() < 140
    sizes = component_sizes(nearest, distances, 4, 0.9)
    assert (sizes == np.bincount(label)[label]).all()


def test_medians_of_groups_are_the_lower_ones_of_their_values():
    rng = np.random.default_rng(9)
    owner, values = rng.integers(0, 30, 90), rng.normal(size=90)
    owner[owner == 7] = 8  # a group without values
    medians, some = group_medians(owner, values, 30)
    for g in range(30):
        own = np.sort(values[owner == g])
        assert some[g] == (len(own) > 0)
        assert medians[g] == (own[(len(own) - 1) // 2] if len(own) else 0.0)


def test_medians_of_windows_are_those_of_their_slices():
    rng = np.random.default_rng(9)
    values, variances = rng.normal(size=(2, 50))
    first = rng.integers(0, 50, 30)
    windows = np.stack([first, np.minimum(first + rng.integers(0, 9, 30), 50)])
    medians, means, count = window_medians(values, variances, windows)
    for i, (start, end) in enumerate(windows.T):
        assert count[i] == end - start
        assert medians[i] == (np.median(values[start:end]) if end > start else 0.0)
        np.testing.assert_allclose(means[i], variances[start:end].mean() if end > start else 0.0)
