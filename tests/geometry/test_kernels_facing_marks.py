"""The nearest mark that faces alike, against brute force."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geometry.kernels.facing_marks import FacingMarks


def unit(rng, count):
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def slow_distance(places, facing, points, normals, least_cosine):
    apart = np.linalg.norm(places[:, None] - points[None], axis=2)
    return np.where(facing @ normals.T > least_cosine, apart, np.inf).min(axis=1)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    count=st.integers(1, 80),
    cell_mm=st.floats(0.05, 3.0),
    cosine=st.floats(-0.9, 0.95),
)
def test_it_matches_brute_force(seed, count, cell_mm, cosine):
    rng = np.random.default_rng(seed)
    points, normals = rng.uniform(0.0, [4.0, 1.0, 6.0], (count, 3)), unit(rng, count)
    places, facing = rng.uniform(-2.0, [7.0, 3.0, 8.0], (30, 3)), unit(rng, 30)
    found = FacingMarks(points, normals, cell_mm).distance_mm(places, facing, cosine)
    assert np.allclose(found, slow_distance(places, facing, points, normals, cosine), atol=1e-12)


def test_the_other_side_of_a_thin_sheet_does_not_count():
    grid = np.stack(np.meshgrid(np.arange(20.0), np.arange(20.0)), axis=2).reshape(-1, 2)
    front = np.column_stack([grid, np.zeros(len(grid))])
    back = np.column_stack([[5.0], [5.0], [-0.1]])
    marks = FacingMarks(front, np.tile([0.0, 0.0, 1.0], (len(front), 1)), 1.5)
    assert marks.distance_mm(back, np.array([[0.0, 0.0, -1.0]]), 0.3)[0] == np.inf
    assert marks.distance_mm(back, np.array([[0.0, 0.6, 0.8]]), 0.3)[0] == pytest.approx(0.1)


def test_many_cells_are_too_many_and_become_wider():
    points = np.array([[0.0, 0.0, 0.0], [1e4, 1e4, 1e4]])
    marks = FacingMarks(points, np.tile([0.0, 0.0, 1.0], (2, 1)), 1e-3)
    assert marks.distance_mm(points + 3.0, np.tile([0.0, 0.0, 1.0], (2, 1)), 0.0) == pytest.approx(
        np.full(2, np.sqrt(27.0))
    )


def test_no_marks_are_no_grid():
    with pytest.raises(ValueError, match="no marks"):
        FacingMarks(np.empty((0, 3)), np.empty((0, 3)), 1.0)
