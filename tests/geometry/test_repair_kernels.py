"""The kernels of the repair volume against slow, obvious twins."""

import manifold3d
import numpy as np
import pytest

from geometry.damage.local_shape import frames_along
from geometry.damage.skin import Skin
from geometry.errors import CannotRepair
from geometry.kernels.implicit import blend_quadrics, nearest_points
from geometry.kernels.implicit_solid import column_crossings, nodes_inside
from geometry.repair.cut_body import lost_beyond_band
from geometry.types import Bools, Floats, Mesh
from tests.geometry import repair_blades as blades


def slow_blend(
    nodes: Floats,
    points: Floats,
    frames: Floats,
    bending: Floats,
    width: Floats,
    reach: float,
    widening: float,
) -> tuple[Floats, Floats]:
    signed, nearest = np.full(len(nodes), np.inf), np.full(len(nodes), np.inf)
    for k, node in enumerate(nodes):
        off = node - points
        distance = np.linalg.norm(off, axis=1)
        u, v, n = np.einsum("pij,pj->ip", frames, off)
        sag = 0.5 * (bending[:, 0] * u**2 + 2.0 * bending[:, 1] * u * v + bending[:, 2] * v**2)
        sag = sag / np.maximum(1.0, (u**2 + v**2) / (1.5 * width) ** 2)
        wide = width**2 + (widening * np.maximum(distance.min() - width, 0.0)) ** 2
        weight = width**2 * np.exp(-(distance**2 - distance.min() ** 2) / wide)
        weight[distance > reach] = 0.0
        if weight.any():
            signed[k] = (weight * (n - sag)).sum() / weight.sum()
            nearest[k] = distance.min()
    return signed, nearest


def test_the_blend_is_the_weighted_mean_of_the_quadrics() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0.3, 1.7, (12, 3))
    normals = rng.standard_normal((12, 3))
    frames = frames_along(normals / np.linalg.norm(normals, axis=1)[:, None])
    bending, width = rng.standard_normal((12, 3)), rng.uniform(0.2, 0.4, 12)
    origin, step, shape, reach = np.array([-0.1, 0.05, 0.0]), 0.23, (9, 8, 10), 0.6
    nearest = nearest_points(shape, origin, step, points, reach)
    signed = blend_quadrics(nearest, origin, step, points, frames, bending, width, reach, 0.7)
    nodes = origin + step * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    slow_signed, slow_nearest = slow_blend(nodes, points, frames, bending, width, reach, 0.7)
    np.testing.assert_allclose(signed.ravel(), slow_signed, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(nearest.ravel(), slow_nearest, rtol=1e-9)


def test_a_sphere_of_exact_quadrics_is_a_sphere() -> None:
    index = np.arange(4000) + 0.5
    z, turn = 1.0 - index / 2000.0, np.pi * (1.0 + 5.0**0.5) * index
    normals = np.column_stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z])
    radius = 3.0
    bending = np.tile([-1.0 / radius, 0.0, -1.0 / radius], (len(normals), 1))
    place, points = (np.full(3, -4.0), 0.2), radius * normals
    nearest = nearest_points((41, 41, 41), *place, points, 0.5)
    width = np.full(len(normals), 0.25)
    signed = blend_quadrics(nearest, *place, points, frames_along(normals), bending, width, 0.5, 0.7)
    node = -4.0 + 0.2 * np.arange(41)
    exact = np.linalg.norm(np.stack(np.meshgrid(node, node, node, indexing="ij"), -1), axis=-1) - radius
    band = nearest < 0.3
    assert band.sum() > 5000
    assert np.abs(signed - exact)[band].max() < 0.02
    assert np.abs(signed - exact)[band & (np.abs(exact) < 0.05)].max() < 1e-3


def solid_angles(point: Floats, triangles: Floats) -> float:
    """Winding number of a mesh about a point (van Oosterom and Strackee, 1983)."""
    a, b, c = np.moveaxis(triangles - point, 1, 0)
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    top = (a * np.cross(b, c)).sum(axis=1)
    bottom = la * lb * lc + (a * b).sum(axis=1) * lc + (b * c).sum(axis=1) * la + (c * a).sum(axis=1) * lb
    return float(np.arctan2(top, bottom).sum() / (2.0 * np.pi))


def wedge() -> Mesh:
    """A sharp blade of 20 degrees, closed: planes at its edge have wrong sides."""
    half = np.tan(np.deg2rad(10.0)) * 4.0
    prism = manifold3d.CrossSection([[(0.0, 0.0), (4.0, -half), (4.0, half)]]).extrude(3.0)
    return blades.mesh_of(prism)


def test_closest_points_and_signs_match_brute_force() -> None:
    rng = np.random.default_rng(1)
    for mesh in (wedge(), blades.blade_mesh(1.5)):
        low, high = mesh.vertices_mm.min(axis=0) - 2.0, mesh.vertices_mm.max(axis=0) + 2.0
        points = rng.uniform(low, high, (150, 3))
        distance, feet, face = Skin(mesh).closest(points)
        triangles = mesh.vertices_mm[mesh.faces]
        weights = rng.dirichlet([0.6, 0.6, 0.6], 400)
        for point, off, foot, own in zip(points, distance, feet, face, strict=True):
            assert abs(np.linalg.norm(point - foot) - abs(off)) < 1e-9
            assert (off < 0.0) == (solid_angles(point, triangles) > 0.5)
            tried = np.linalg.norm(triangles[own].T @ weights.T - point[:, None], axis=0)
            corners = np.linalg.norm(triangles - point, axis=2)
            assert abs(off) <= min(tried.min(), corners.min()) + 1e-12
        near = np.linalg.norm(triangles.mean(axis=1)[:, None] - points[None], axis=2).min(axis=0)
        assert (np.abs(distance) <= near + 1e-12).all()


def test_columns_through_a_box_and_a_ball_have_their_chords() -> None:
    box = blades.mesh_of(manifold3d.Manifold.cube((2.0, 1.0, 3.0)))
    start, height = column_crossings(box.vertices_mm[box.faces], np.array([0.0, 0.0]), 0.25, (9, 5))
    assert set(np.diff(start).tolist()) <= {0, 2}  # columns on edges and diagonals too
    np.testing.assert_allclose(height.reshape(-1, 2), np.tile([0.0, 3.0], (len(height) // 2, 1)))
    ball = blades.mesh_of(manifold3d.Manifold.sphere(2.0, 200))
    start, height = column_crossings(ball.vertices_mm[ball.faces], np.array([-2.1, -2.1]), 0.1, (43, 43))
    area_mm2 = float((height[1::2] - height[::2]).sum()) * 0.01
    assert abs(area_mm2 / (4.0 / 3.0 * np.pi * 8.0) - 1.0) < 3e-3


def test_nodes_inside_match_the_winding_number() -> None:
    mesh = blades.blade_mesh(1.5)
    triangles = mesh.vertices_mm[mesh.faces]
    origin, step, shape = np.array([-14.0, -3.0, 10.0]), 1.7, (17, 5, 6)
    start, height = column_crossings(triangles, origin[:2], step, shape[:2])
    inside = nodes_inside(start, height, origin[2], step, shape)
    assert 50 < inside.sum() < inside.size - 50
    for index in np.ndindex(shape):
        assert inside[index] == (solid_angles(origin + step * np.array(index), triangles) > 0.5)


def metal_behind_a_break(wrong_mm: float) -> tuple[Bools, Bools, Floats]:
    """20 x 20 x 20 nodes whose lowest layer is the band of a break, one node in eighteen of it `wrong_mm`."""
    band = np.zeros((20, 20, 20), bool)
    band[:, :, 0] = True
    field = np.full(band.shape, np.inf)
    field[:, :, 0] = -0.5
    field[2:4, :11, 0] = wrong_mm
    return ~band, band, field


def test_nodes_that_hardly_stand_off_the_break_do_not_deny_the_side_of_the_metal_behind_it() -> None:
    """Where a break turns sharply into the skin, some quadrics put a little of the metal outside."""
    assert not lost_beyond_band(*metal_behind_a_break(0.05)).any()


def test_nodes_as_far_outside_as_others_are_inside_show_a_hole_in_the_break() -> None:
    with pytest.raises(CannotRepair, match="open"):
        lost_beyond_band(*metal_behind_a_break(0.5))
