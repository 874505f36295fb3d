"""The grid's neighbours against brute force and scipy's tree."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from geometry.kernels.neighbours import (
    NEAR_MM,
    TURNS,
    choose,
    counting_sort,
    k_nearest,
    near_each_other,
    room_for,
    sorted_nearest,
)


def slow_distances(points, k):
    return np.sort(np.linalg.norm(points[:, None] - points[None], axis=2), axis=1)[:, :k]


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), count=st.integers(1, 60), k=st.integers(1, 60), flat=st.booleans())
def test_small_clouds_match_brute_force(seed, count, k, flat):
    points = np.random.default_rng(seed).normal(size=(count, 3)) * ([1.0, 1.0, 0.0] if flat else 1.0)
    k = min(k, count)
    indices, distances = k_nearest(points, k)
    assert np.allclose(distances, slow_distances(points, k), atol=1e-12)
    assert (indices[:, 0] == np.arange(count)).all()
    assert np.allclose(np.linalg.norm(points[indices] - points[:, None], axis=2), distances, atol=1e-12)


def test_a_surface_of_uneven_density_with_a_far_cluster_matches_a_tree():
    rng = np.random.default_rng(3)
    sheet = np.column_stack(
        [rng.exponential(10.0, 5000), rng.uniform(0, 100, 5000), rng.normal(scale=0.01, size=5000)]
    )
    far = rng.normal(scale=0.1, size=(40, 3)) + np.array([500.0, -300.0, 80.0])
    points = np.concatenate([sheet, far])
    _, distances = k_nearest(points, 16)
    assert np.abs(distances - cKDTree(points).query(points, 16)[0]).max() < 1e-12


def test_strays_far_from_everything_match_a_tree():
    rng = np.random.default_rng(6)
    sheet = np.column_stack([rng.uniform(0, 30, (4000, 2)), rng.normal(scale=0.01, size=4000)])
    strays = rng.uniform(-200.0, 200.0, (60, 3))
    points = np.concatenate([sheet, strays, [[1e6, 0.0, 0.0]]])
    _, distances = k_nearest(points, 9)
    assert np.allclose(distances, cKDTree(points).query(points, 9)[0], rtol=1e-12, atol=1e-12)


def test_the_sorted_answer_is_that_of_the_sorted_points():
    points = np.random.default_rng(7).normal(size=(3000, 3))
    order, nearest, distances = sorted_nearest(points, 5)
    assert np.array_equal(np.sort(order), np.arange(3000))
    indices, expected = k_nearest(points[order], 5)
    assert np.array_equal(nearest, indices)
    assert np.array_equal(distances, expected)


def test_duplicates_keep_the_point_itself_first():
    points = np.repeat(np.random.default_rng(4).normal(size=(20, 3)), 4, axis=0)
    indices, distances = k_nearest(points, 5)
    assert indices[:, 0].tolist() == list(range(80))
    assert (distances[:, :4] == 0.0).all()
    assert all(len(set(row)) == 5 for row in indices)
    indices, distances = k_nearest(np.zeros((9, 3)), 4)
    assert indices[:, 0].tolist() == list(range(9))
    assert (distances == 0.0).all()


@pytest.mark.parametrize("k", [0, 6])
def test_an_impossible_k_is_refused(k):
    with pytest.raises(ValueError, match="neighbours asked"):
        k_nearest(np.zeros((5, 3)), k)


def test_counting_sort_is_stable():
    keys = np.array([2, 0, 2, 1, 0])
    starts, order = counting_sort(keys, 4)
    assert starts.tolist() == [0, 2, 3, 5, 5]
    assert order.tolist() == np.argsort(keys, kind="stable").tolist()


def test_points_of_one_cell_follow_each_other():
    rng = np.random.default_rng(4)
    points = rng.uniform(-30.0, 30.0, (5000, 3))
    order = near_each_other(points)
    assert sorted(order.tolist()) == list(range(5000))
    cells = np.floor(points[order] / NEAR_MM).astype(int)
    runs = 1 + np.count_nonzero(np.any(np.diff(cells, axis=0) != 0, axis=1))
    assert runs == len(np.unique(cells, axis=0))


def test_a_stray_point_far_away_costs_no_memory_and_takes_its_turn():
    points = np.array([[0.0, 0.0, 0.0], [1e9, -1e9, 0.5], [TURNS * NEAR_MM, 0.0, 0.0], [3.0, 0.0, 0.0]])
    assert sorted(near_each_other(points).tolist()) == [0, 1, 2, 3]
    assert near_each_other(np.zeros((0, 3))).tolist() == []


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), found=st.integers(1, 300), k=st.integers(1, 40), alike=st.booleans())
def test_the_chosen_are_those_that_a_sort_puts_first(seed, found, k, alike):
    rng = np.random.default_rng(seed)
    k = min(k, found)
    around, _, apart2, ranks = room_for(found + 5)
    around[:] = rng.permutation(found + 5) + 1000
    apart2[:] = rng.integers(0, 6, found + 5) / 3.0 if alike else rng.uniform(0.0, 1e-3, found + 5)
    apart2[found:] = -1.0  # what stands there from before is no candidate
    near, near2 = np.empty(k, np.int64), np.empty(k)
    farthest2 = choose(around, apart2, ranks, found, near, near2)
    order = np.argsort(apart2[:found], kind="stable")[:k]
    assert np.array_equal(near, around[order])
    assert np.array_equal(near2, apart2[order])
    assert farthest2 == near2[-1]
