"""Closest points on triangles against a slow, obvious projection."""

import numpy as np
import pytest

from geometry.blade.solid import faces_around, solid_normals
from geometry.kernels.triangle import closest_on_triangles, describe_feet, refine_closest
from tests.geometry import blades


def slow_foot(point, triangle):
    """The nearest of the projection, if it falls inside, and the nearest point of each side."""
    a, b, c = triangle
    candidates = [_on_segment(point, *side) for side in ((a, b), (b, c), (c, a))]
    u, v = np.linalg.lstsq(np.column_stack([b - a, c - a]), point - a, rcond=None)[0]
    if min(u, v, 1.0 - u - v) >= 0.0:
        candidates.append(a + u * (b - a) + v * (c - a))
    return min(candidates, key=lambda foot: np.linalg.norm(foot - point))


def _on_segment(point, a, b):
    t = np.clip((point - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return a + t * (b - a)


def test_feet_on_single_triangles_match_the_slow_projection():
    rng = np.random.default_rng(1)
    points, triangles = rng.normal(size=(500, 3)), rng.normal(size=(500, 3, 3))
    weights = closest_on_triangles(points, triangles)
    feet = np.einsum("nc,ncj->nj", weights, triangles)
    slow = np.array([slow_foot(p, t) for p, t in zip(points, triangles, strict=True)])
    assert np.abs(feet - slow).max() < 1e-9
    assert np.abs(weights.sum(axis=1) - 1.0).max() < 1e-12


@pytest.mark.parametrize("point", [[0.5, 1.0, 0.0], [-1.0, 0.0, 0.0], [3.0, 0.0, 1.0]])
def test_a_triangle_without_area_still_gives_its_nearest_point(point):
    sliver = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]])
    weights = closest_on_triangles(np.array([point]), sliver)
    foot = weights[0] @ sliver[0]
    assert foot == pytest.approx([np.clip(point[0], 0.0, 2.0), 0.0, 0.0])


def test_the_walk_reaches_the_nearest_face_of_all_from_a_neighbour():
    mesh = blades.mesh(blades.Blade(), around=60, up=12)
    rng = np.random.default_rng(2)
    t, z = rng.uniform(0, 2 * np.pi, 40), rng.uniform(5, 100, 40)
    points = blades.Blade().point(t, z) + rng.normal(scale=0.05, size=(40, 3))
    feet = [[slow_foot(p, tri) for tri in mesh.vertices_mm[mesh.faces]] for p in points]
    best = np.linalg.norm(np.array(feet) - points[:, None], axis=2)
    offsets, around = faces_around(mesh)
    start = np.array([around[offsets[mesh.faces[f, 0]]] for f in best.argmin(axis=1)])
    face, weights = refine_closest(points, mesh.vertices_mm, mesh.faces, start, offsets, around)
    n = solid_normals(mesh)
    feet, _, distance = describe_feet(
        points, mesh.vertices_mm, mesh.faces, face, weights, n.corner, n.face, n.edge, n.vertex
    )
    assert np.abs(np.abs(distance) - best.min(axis=1)).max() < 1e-12
    assert np.abs(np.linalg.norm(points - feet, axis=1) - best.min(axis=1)).max() < 1e-12
