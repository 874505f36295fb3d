"""Local quadrics against closed forms and a least-squares twin in numpy."""

import numpy as np
import pytest

from geometry.errors import BadInput
from geometry.kernels.quadric import plane_heights
from geometry.scan.surface import k_nearest, local_shape


def sphere(count, radius, rng):
    v = rng.normal(size=(count, 3))
    return radius * v / np.linalg.norm(v, axis=1, keepdims=True)


def slow_quadric(points, i, neighbours, normal):
    """Gaussian curvature, normal and height of the least-squares quadric over the plane of `normal`."""
    u = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    u /= np.linalg.norm(u)
    v = np.cross(normal, u)
    local = (points[np.append(i, neighbours)] - points[i]) @ np.column_stack([u, v, normal])
    x, y, z = local.T
    c, gx, gy, a, b, d = np.linalg.lstsq(np.column_stack([x**0, x, y, x * x, x * y, y * y]), z, rcond=None)[0]
    tilted = normal - gx * u - gy * v
    return (4 * a * d - b * b) / (1 + gx**2 + gy**2) ** 2, tilted / np.linalg.norm(tilted), c


def test_curvature_of_a_sphere():
    points = sphere(20_000, 10.0, np.random.default_rng(1))
    shape = local_shape(points)
    assert np.nanmedian(shape.gaussian_per_mm2) == pytest.approx(0.01, rel=5e-3)
    assert np.nanmedian(np.abs(shape.mean_per_mm)) == pytest.approx(0.1, rel=5e-3)
    assert np.nanmin(np.abs(np.einsum("nj,nj->n", shape.normals, points)) / 10.0) > 1.0 - 1e-6
    assert np.nanmax(np.abs(shape.offset_mm)) < 1e-4


def test_saddle_has_negative_curvature():
    x, y = np.random.default_rng(2).uniform(-1, 1, (2, 4000))
    shape = local_shape(np.column_stack([x, y, 0.2 * x * y]))
    middle = np.hypot(x, y) < 0.5
    expected = -(0.2**2) / (1 + 0.04 * (x**2 + y**2)) ** 2
    assert np.abs(shape.gaussian_per_mm2 - expected)[middle].max() < 1e-3


def test_the_kernel_fits_what_a_plain_least_squares_fits():
    rng = np.random.default_rng(3)
    points = sphere(300, 5.0, rng) + rng.normal(scale=0.02, size=(300, 3))
    shape = local_shape(points)
    nearest, _ = k_nearest(points, 30)
    for i in range(0, 300, 17):
        near = points[nearest[i, :16]]
        normal = np.linalg.svd(near - near.mean(axis=0))[2][2]
        gaussian, tilted, offset = slow_quadric(
            points, i, shape.neighbours[i][shape.neighbours[i] >= 0], normal
        )
        sign = np.sign(tilted @ shape.normals[i])
        assert shape.gaussian_per_mm2[i] == pytest.approx(gaussian, rel=1e-6, abs=1e-9)
        assert np.abs(sign * tilted - shape.normals[i]).max() < 1e-8
        assert shape.offset_mm[i] == pytest.approx(sign * offset, abs=1e-9)


def test_neighbourhood_takes_at_most_two_of_each_direction():
    rng = np.random.default_rng(4)
    dense = np.column_stack([rng.uniform(0.01, 0.2, 100), rng.normal(scale=0.01, size=100), np.zeros(100)])
    sparse = np.column_stack([rng.uniform(-1, 1, (150, 2)), np.zeros(150)])
    points = np.concatenate([[[0.0, 0.0, 0.0]], dense, sparse])
    shape = local_shape(points, candidates=120)
    chosen = shape.neighbours[0][shape.neighbours[0] >= 0]
    angle = np.arctan2(points[chosen, 1], points[chosen, 0])
    ahead = np.abs(angle) < np.pi / 8
    assert ahead.sum() <= 4
    assert len(chosen) >= 10


def test_height_over_the_neighbours_plane_leaves_the_point_out():
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-1, 1, (400, 2)), rng.normal(scale=0.01, size=400)])
    points[7, 2] = 0.5
    nearest, _ = k_nearest(points, 17)
    height, scatter = plane_heights(points, nearest, 13, 0, 400)
    for i in (7, 50, 222):
        near = points[nearest[i, 1:13]]
        normal = np.linalg.svd(near - near.mean(axis=0))[2][2]
        off = (near - near.mean(axis=0)) @ normal
        assert abs(height[i]) == pytest.approx(abs((points[i] - near.mean(axis=0)) @ normal), rel=1e-9)
        assert scatter[i] == pytest.approx(np.sqrt(np.mean(off**2)), rel=1e-9)


def test_points_that_determine_nothing_say_so():
    line = np.column_stack([np.arange(10.0), np.zeros(10), np.zeros(10)])
    assert np.isnan(local_shape(line).gaussian_per_mm2).all()
    with pytest.raises(BadInput, match="quadric"):
        local_shape(line[:6])
    with pytest.raises(BadInput, match="neighbours asked"):
        k_nearest(line, 11)
