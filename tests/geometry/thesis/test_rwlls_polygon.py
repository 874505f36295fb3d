"""Points are ordered by the polygon alone, and what strays belongs to none."""

import numpy as np
import pytest

from geometry.errors import CannotMeasure
from geometry.thesis.polygon import Polygon, order_points


def ring(count=300, stretch=4.0):
    angle = 2.0 * np.pi * np.arange(count) / count
    points = np.column_stack([stretch * np.cos(angle), np.sin(angle)])
    normals = np.column_stack([np.cos(angle) / stretch, np.sin(angle)])
    return points, normals / np.linalg.norm(normals, axis=1)[:, None]


def is_cyclic(order, count):
    """The order is 0 .. count - 1 from anywhere, either way round."""
    steps = np.diff(np.append(order, order[0])) % count
    return bool((steps == 1).all() or (steps == count - 1).all())


@pytest.mark.parametrize("seed", range(5))
def test_shuffled_points_with_normals_of_either_sign_come_in_order(seed):
    rng = np.random.default_rng(seed)
    points, normals = ring()
    shuffle = rng.permutation(len(points))
    signs = rng.choice([-1.0, 1.0], len(points))[:, None]
    order = order_points(points[shuffle], signs * normals[shuffle])
    assert len(order) == len(points)
    assert is_cyclic(shuffle[order], len(points))


@pytest.mark.parametrize("seed", range(5))
def test_points_off_the_profile_are_left_out(seed):
    rng = np.random.default_rng(seed)
    points, normals = ring()
    at = rng.choice(len(points), 6, replace=False)
    astray = points[at] + 0.05 * normals[at] + 0.004 * rng.normal(size=(6, 2))
    order = order_points(np.vstack([points, astray]), np.vstack([normals, normals[at]]))
    kept = order[order < len(points)]
    assert len(kept) >= len(points) - 12
    assert is_cyclic(np.argsort(np.argsort(kept)), len(kept))


def test_no_node_keeps_more_than_two_edges():
    rng = np.random.default_rng(9)
    points, normals = ring(600)
    polygon = Polygon.through(points + rng.normal(scale=0.01, size=points.shape), normals)
    assert max(map(len, polygon.joined)) > 2
    polygon.modify_imperfect_nodes()
    assert {len(met) for met in polygon.joined} <= {0, 2}
    assert all(i in polygon.joined[j] for i, met in enumerate(polygon.joined) for j in met)


def test_an_arc_does_not_close():
    points = np.column_stack([np.arange(100.0), np.zeros(100)])
    with pytest.raises(CannotMeasure, match="closed profile"):
        order_points(points, np.tile([0.0, 1.0], (100, 1)))
