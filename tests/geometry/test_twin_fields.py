"""The fields behind the twin, each against a slow or closed-form twin of its own."""

import numpy as np
import pytest
from scipy.interpolate import BSpline

from geometry.freeform import COMPONENTS, bending_block, fit_freeform, lattice_over
from geometry.kernels.ffd import add_block, evaluate, shapes
from geometry.kernels.thinplate import TURN
from geometry.offset import BENDING_REACH, BENDING_WIDTH, Nodes, bending_energy, fit_offset, scatter_nodes
from geometry.refine import refine
from geometry.solid import check_solid, solid_normals, volume_mm3
from geometry.types import Floats, Mesh


def tensor_spline(points: Floats, counts: tuple[int, int, int], coefficients: Floats) -> Floats:
    """The tensor-product spline, by scipy's one-dimensional basis."""
    bases = [
        BSpline.design_matrix(points[:, axis], np.arange(-3.0, n + 1.0), 3).toarray()
        for axis, n in enumerate(counts)
    ]
    grid = coefficients.reshape(*counts[::-1], -1)
    return np.einsum("pa,pb,pc,cbam->pm", *bases, grid)


def test_the_volumetric_spline_is_the_tensor_product() -> None:
    rng = np.random.default_rng(1)
    counts = (5, 6, 7)
    points = rng.uniform(0.0, 1.0, (200, 3)) * (np.array(counts) - 3.0)
    coefficients = rng.normal(size=(int(np.prod(counts)), 2))
    found = evaluate(points, np.array(counts), coefficients)
    np.testing.assert_allclose(found, tensor_spline(points, counts, coefficients), atol=1e-12)


def test_shapes_name_the_nodes_that_evaluate_uses() -> None:
    rng = np.random.default_rng(2)
    counts = np.array([5, 6, 7])
    points = rng.uniform(0.0, 1.0, (50, 3)) * (counts - 3.0)
    first, weights = shapes(points, counts)
    steps = [(c * 6 + b) * 5 + a for c in range(4) for b in range(4) for a in range(4)]
    values = rng.normal(size=(210, 1))
    by_hand = (weights * values[first[:, None] + np.array(steps), 0]).sum(axis=1)
    np.testing.assert_allclose(by_hand, evaluate(points, counts, values)[:, 0], atol=1e-12)


def test_bending_block_is_the_integral_of_squared_second_derivatives() -> None:
    rng = np.random.default_rng(3)
    coefficients = rng.normal(size=(64, 1))
    nodes, weights = np.polynomial.legendre.leggauss(5)
    at = 0.5 * (nodes + 1.0)
    points = np.array([[x, y, z] for z in at for y in at for x in at])
    share = np.array([a * b * c for c in weights for b in weights for a in weights]) / 8.0
    h = 1e-3

    def value(shift: Floats) -> Floats:
        return tensor_spline(np.clip(points + shift, 0.0, 1.0), (4, 4, 4), coefficients)[:, 0]

    total = 0.0
    for i, j in np.ndindex(3, 3):
        e, f = h * np.eye(3)[i], h * np.eye(3)[j]
        second = (value(e + f) - value(e - f) - value(f - e) + value(-e - f)) / (4.0 * h * h)
        total += float((share * second**2).sum())
    found = float(coefficients[:, 0] @ bending_block() @ coefficients[:, 0])
    assert found == pytest.approx(total, rel=1e-4)


def test_add_block_fills_the_lower_bands() -> None:
    rng = np.random.default_rng(4)
    dense, bands = np.zeros((9, 9)), np.zeros((9, 6))
    for start in (0, 3):
        unknowns = start + np.array([0, 1, 3, 5])
        half = rng.normal(size=(4, 4))
        dense[np.ix_(unknowns, unknowns)] += half + half.T
        add_block(bands, unknowns, half + half.T)
    for i, j in np.ndindex(9, 9):
        if i >= j:
            assert (bands[j, i - j] if i - j < 6 else 0.0) == pytest.approx(dense[i, j])


def blade_like(rng: np.random.Generator, count: int) -> tuple[Floats, Floats]:
    """Points on an elliptic cylinder and their normals."""
    angle, z = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(0.0, 60.0, count)
    points = np.column_stack([15.0 * np.cos(angle), 4.0 * np.sin(angle), z])
    normals = np.column_stack([np.cos(angle) / 15.0, np.sin(angle) / 4.0, np.zeros(count)])
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_the_free_form_recovers_a_bend_it_can_represent() -> None:
    points, normals = blade_like(np.random.default_rng(5), 4000)
    lattice = lattice_over(points, 60)
    bend = np.column_stack([0.002 * points[:, 2], 1e-4 * points[:, 2] ** 2, np.zeros(len(points))])
    field = fit_freeform(
        lattice,
        points,
        normals,
        np.einsum("nj,nj->n", bend, normals),
        np.full(len(points), 1e8),
        stiffness=np.full(COMPONENTS, 1e2),
        slide=1e-3,
        form_mm=0.03,
    )
    np.testing.assert_allclose(field.along(points, normals), np.einsum("nj,nj->n", bend, normals), atol=2e-4)
    spread = field.draws(np.random.default_rng(0), points, normals, 64).std(axis=1)
    assert spread.max() < 1e-3
    far = np.array([[0.0, 0.0, 400.0]])
    np.testing.assert_allclose(field.shift(far)[0], 0.0, atol=1e-12)


def test_nodes_keep_their_distance_and_cover_the_surface() -> None:
    points, normals = blade_like(np.random.default_rng(6), 20_000)
    nodes = scatter_nodes(points, normals, 0.2, 1.5)
    apart = np.linalg.norm(nodes.points_mm[:, None] - nodes.points_mm, axis=2) / 1.5
    turned = np.linalg.norm(nodes.normals[:, None] - nodes.normals, axis=2) / TURN
    rho = np.hypot(apart, turned) + 10.0 * np.eye(len(apart))
    assert rho.min() >= 1.0
    assert (nodes.owner(points, normals) >= 0).all()
    assert nodes.area_mm2.sum() == pytest.approx(0.2 * len(points))


def test_near_nodes_are_those_of_a_full_search() -> None:
    points, normals = blade_like(np.random.default_rng(7), 3000)
    nodes = scatter_nodes(points, normals, 1.0, 2.0)
    found, rho = nodes.near(points[:200], normals[:200], 2.0, 30)
    away = np.linalg.norm(points[:200, None] - nodes.points_mm, axis=2) / 2.0
    turn = np.linalg.norm(normals[:200, None] - nodes.normals, axis=2) / TURN
    full = np.hypot(away, turn)
    for i in range(200):
        expected = np.flatnonzero(full[i] < 2.0)
        assert set(found[i][found[i] >= 0]) == set(expected)
        np.testing.assert_allclose(np.sort(full[i][expected]), rho[i][found[i] >= 0])


def round_bar(spacing: float) -> Nodes:
    angle, z = np.meshgrid(np.arange(0.0, 2.0 * np.pi, 0.03), np.arange(0.0, 20.0, 0.25))
    normals = np.column_stack([np.cos(angle.ravel()), np.sin(angle.ravel()), 0.0 * z.ravel()])
    points = 5.0 * normals + np.column_stack([0.0 * z.ravel(), 0.0 * z.ravel(), z.ravel()])
    order = np.random.default_rng(8).permutation(len(points))
    return scatter_nodes(points[order], normals[order], 0.15 * 0.25, spacing)


def test_interpolation_is_exact_for_what_is_linear_on_the_unrolled_surface() -> None:
    nodes = round_bar(1.0)
    angle = np.random.default_rng(9).uniform(1.0, 2.0, 100)
    z = np.random.default_rng(10).uniform(3.0, 17.0, 100)
    normals = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * z])
    carry = nodes.interpolation(5.0 * normals + np.column_stack([0 * z, 0 * z, z]), normals)
    np.testing.assert_allclose(carry @ np.ones(len(nodes.points_mm)), 1.0, atol=1e-9)
    node_angle = np.arctan2(nodes.points_mm[:, 1], nodes.points_mm[:, 0])
    values = 0.7 * 5.0 * node_angle - 0.3 * nodes.points_mm[:, 2]
    np.testing.assert_allclose(carry @ values, 0.7 * 5.0 * angle - 0.3 * z, atol=0.02)


def test_bending_is_nothing_for_a_slope_and_the_integral_for_a_wave() -> None:
    nodes = round_bar(0.8)
    energy = bending_energy(nodes)
    z = nodes.points_mm[:, 2]
    assert float(z @ (energy @ z)) < 1e-6 * float(z @ z)
    wave = np.cos(2.0 * np.arctan2(nodes.points_mm[:, 1], nodes.points_mm[:, 0]))
    exact = (2.0 / 5.0) ** 4 * np.pi * 5.0 * 20.0  # integral of (s_uu)^2 over the bar
    assert float(wave @ (energy @ wave)) == pytest.approx(exact, rel=0.08)
    assert np.pi * BENDING_REACH**2 < BENDING_WIDTH


def test_the_offset_and_its_sigma_are_honest() -> None:
    """Fields drawn from the prior itself, seen through noise: errors over sigmas have unit spread."""
    nodes = round_bar(1.0)
    rng = np.random.default_rng(11)
    angle, z = rng.uniform(-np.pi, np.pi, 3000), rng.uniform(0.0, 12.0, 3000)  # nothing seen above 12 mm
    normals = np.column_stack([np.cos(angle), np.sin(angle), 0.0 * z])
    points = 5.0 * normals + np.column_stack([0 * z, 0 * z, z])
    carry = nodes.interpolation(points, normals)
    prior = bending_energy(nodes).toarray() + np.diag(nodes.area_mm2) / 2.0**4
    covariance = np.linalg.inv(prior * 2.0**2 / (8.0 * 0.01**2))
    ratios = []
    for seed in range(4):
        truth = np.random.default_rng(seed).multivariate_normal(np.zeros(len(prior)), covariance)
        seen = carry @ truth + rng.normal(0.0, 0.01, len(points))
        found = fit_offset(
            nodes,
            points,
            normals,
            seen,
            np.full(len(points), 0.01),
            prior_sigma_mm=0.01,
            length_mm=2.0,
            draws=200,
            rng=np.random.default_rng(1),
        )
        ratios.append((found.value_mm - truth) / found.sigma_mm)
        assert found.sigma_mm[nodes.points_mm[:, 2] > 16.0].mean() > 2.0 * found.sigma_mm[found.held].mean()
    assert 0.85 < np.std(np.concatenate(ratios)) < 1.15


def test_refining_keeps_the_solid_and_shortens_its_edges() -> None:
    corners = np.array(list(np.ndindex(2, 2, 2)), dtype=np.float64) * [10.0, 3.0, 1.0]
    faces = np.array(
        [
            [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
            [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
        ]
    )  # fmt: skip
    mesh = Mesh(vertices_mm=corners, faces=faces)
    check_solid(mesh)
    bends = np.zeros(12, np.bool_)
    bends[4:6] = True
    refined = refine(mesh, solid_normals(mesh).corner, bends, 1.0)
    check_solid(refined.mesh)
    assert volume_mm3(refined.mesh) == pytest.approx(30.0, rel=1e-12)
    assert (np.diff(refined.parent) >= 0).all()
    inside = refined.mesh.vertices_mm[refined.mesh.faces[bends[refined.parent]]]
    assert np.linalg.norm(inside - np.roll(inside, 1, axis=1), axis=2).max() <= 1.0
    flat = solid_normals(mesh).face[refined.parent]
    np.testing.assert_allclose(refined.corner_normals, np.repeat(flat[:, None], 3, axis=1), atol=1e-12)
