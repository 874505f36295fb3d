"""The fields behind the twin, each against a slow or closed-form twin of its own."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import BSpline

from geometry.blade.solid import check_solid, solid_normals, volume_mm3
from geometry.deformation.freeform import Lattice, lattice_over
from geometry.deformation.kriging import (
    AFFINE,
    Prior,
    Sample,
    fit_wear,
    likeliest_prior,
    rival_priors,
    sample_of,
    typical_prior,
)
from geometry.deformation.offset import (
    BENDING_REACH,
    BENDING_WIDTH,
    Nodes,
    bending_energy,
    fit_offset,
    plate_over,
    scatter_nodes,
)
from geometry.deformation.refine import refine
from geometry.kernels.covariance import TURN as ALIKE
from geometry.kernels.covariance import carried, covariance, covariance_slopes, joint_covariance
from geometry.kernels.ffd import evaluate
from geometry.kernels.thinplate import TURN, back_substitute
from geometry.types import Floats, Mesh


def tensor_spline(points: Floats, counts: tuple[int, int, int], coefficients: Floats) -> Floats:
    """The tensor-product spline, by scipy's one-dimensional basis."""
    bases = [
        BSpline.design_matrix(points[:, axis], np.arange(-3.0, n + 1.0), 3).toarray()
        for axis, n in enumerate(counts)
    ]
    grid = coefficients.reshape(*counts[::-1], -1)
    return np.asarray(np.einsum("pa,pb,pc,cbam->pm", *bases, grid))


def test_the_volumetric_spline_is_the_tensor_product() -> None:
    rng = np.random.default_rng(1)
    counts = (5, 6, 7)
    points = rng.uniform(0.0, 1.0, (200, 3)) * (np.array(counts) - 3.0)
    coefficients = rng.normal(size=(int(np.prod(counts)), 4))
    found = evaluate(points, np.array(counts), coefficients)
    np.testing.assert_allclose(found, tensor_spline(points, counts, coefficients), atol=1e-12)


def blade_like(rng: np.random.Generator, count: int) -> tuple[Floats, Floats]:
    """Points on an elliptic cylinder and their normals."""
    angle, z = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(0.0, 60.0, count)
    points = np.column_stack([15.0 * np.cos(angle), 4.0 * np.sin(angle), z])
    normals = np.column_stack([np.cos(angle) / 15.0, np.sin(angle) / 4.0, np.zeros(count)])
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_the_lattice_follows_a_cubic_exactly() -> None:
    rng = np.random.default_rng(2)
    points, _ = blade_like(rng, 4000)
    lattice = lattice_over(points, 60)
    terms = rng.normal(size=(4, 3))

    def field(own: Floats) -> Floats:
        return np.stack([(own / 20.0) ** k @ terms[k] for k in range(4)], axis=1)

    found = evaluate(lattice.local(points)[0], lattice.counts, lattice.interpolate(field))
    np.testing.assert_allclose(found, field(lattice.own(points)), atol=1e-9)


PRIOR = np.array([0.05, 0.02, 30.0, 12.0, 0.004, 2.5])


def matern(r: Floats) -> Floats:
    a = np.sqrt(5.0) * r
    return np.asarray((1.0 + a + a**2 / 3.0) * np.exp(-a))


def slow_covariance(sample: Sample, others: Sample, prior: Floats) -> tuple[Floats, Floats]:
    """Covariance of wear, and that of ripple."""
    off = sample.places_mm[:, None] - others.places_mm
    alike = matern(np.abs(off[..., 2]) / prior[2]) * matern(np.linalg.norm(off[..., :2], axis=2) / prior[3])
    together = sample.normals @ others.normals.T
    wear = (AFFINE[0] ** 2 + prior[0] ** 2 * alike) * together
    in_section = sample.normals[:, :2] @ others.normals[:, :2].T
    wear += AFFINE[1] ** 2 * (sample.places_mm @ others.places_mm.T) * in_section
    wear += prior[1] ** 2 * alike * np.outer(sample.swell, others.swell)
    b = np.sqrt(3.0) * np.linalg.norm(off, axis=2) / prior[5]
    turned = np.linalg.norm(sample.normals[:, None] - others.normals, axis=2)
    return wear, prior[4] ** 2 * (1.0 + b) * np.exp(-b - 0.5 * (turned / ALIKE) ** 2)


def places(seed: int, count: int) -> tuple[Lattice, Sample]:
    rng = np.random.default_rng(seed)
    points, normals = blade_like(rng, count)
    lattice = lattice_over(blade_like(rng, 4000)[0], 200)
    return lattice, sample_of(lattice, points, normals, np.zeros(count), np.full(count, 1e-6))


def test_covariances_are_those_of_the_formula() -> None:
    _, some = places(3, 40)
    _, others = places(4, 30)
    wear, _ = slow_covariance(some, others, PRIOR)
    asked = (some.places_mm, some.normals, some.swell, others.places_mm, others.normals, others.swell)
    np.testing.assert_allclose(covariance(*asked, PRIOR, AFFINE), wear, atol=1e-12)
    joint = joint_covariance(*asked[:3], PRIOR, AFFINE, some.variance_mm2)
    whole = sum(slow_covariance(some, some, PRIOR)) + np.diag(some.variance_mm2)
    np.testing.assert_allclose(joint, np.triu(whole), atol=1e-11)
    sources = np.random.default_rng(5).normal(size=(30, 4))
    alike = slow_covariance(some, others, PRIOR * [1.0, 0.0, 1.0, 1.0, 1.0, 1.0])[0]
    bare = slow_covariance(some, others, PRIOR * [1e-9, 0.0, 1.0, 1.0, 1.0, 1.0])[0]
    correlation = (alike - bare) / (PRIOR[0] ** 2 * some.normals @ others.normals.T)
    found = carried(some.places_mm, others.places_mm, PRIOR, sources)
    np.testing.assert_allclose(found, correlation @ sources, atol=1e-6)


def test_slopes_of_the_likelihood_are_its_differences() -> None:
    _, some = places(6, 60)
    rng = np.random.default_rng(7)
    some = replace(some, normals=some.normals * rng.uniform(0.9, 1.0, (60, 1)))  # means of several are short
    weights = rng.normal(size=(60, 60))
    weights += weights.T
    asked = (some.places_mm, some.normals, some.swell)
    found = covariance_slopes(*asked, PRIOR, weights)
    for k in range(6):
        step = np.exp(1e-4 * np.eye(6)[k])
        high, low = (sum(slow_covariance(some, some, PRIOR * s)) for s in (step, 1.0 / step))
        assert found[k] == pytest.approx(float((weights * (high - low)).sum() / 2e-4), rel=1e-4, abs=1e-12)


def drawn(seed: int) -> tuple[Lattice, Sample, Sample, Floats]:
    """Wear drawn from its prior: a sample seen below 45 mm with ripple and noise, and places everywhere."""
    lattice, whole = places(seed, 700)
    wear, ripple = slow_covariance(whole, whole, PRIOR)
    rng = np.random.default_rng(seed)
    truth, ripples = (
        rng.multivariate_normal(np.zeros(700), matrix, method="cholesky")
        for matrix in (wear + 1e-12 * np.eye(700), ripple + 1e-12 * np.eye(700))
    )
    values = truth + ripples + rng.normal(0.0, 1e-3, 700)
    order = np.argsort(whole.places_mm[:, 2])[:500]
    seen = replace(whole, value_mm=values).only(order)
    return lattice, seen, whole, truth


def test_wear_and_its_sigma_are_honest_where_seen_and_beyond() -> None:
    ratios = []
    for seed in range(3):
        lattice, seen, whole, truth = drawn(seed)
        wear = fit_wear(seen, Prior.of(PRIOR), lattice)
        points, normals = whole.places_mm @ lattice.axes, whole.normals @ lattice.axes
        error_mm = wear.freeform.along(points, normals) - truth
        sigma_mm = wear.sigma_mm(points, normals)
        beyond = whole.places_mm[:, 2] > seen.places_mm[:, 2].max() + 5.0
        assert sigma_mm[beyond].mean() > 2.0 * sigma_mm[~beyond].mean()
        ratios.append([np.sqrt(np.mean((error_mm / sigma_mm)[part] ** 2)) for part in (beyond, ~beyond)])
    assert (np.mean(ratios, axis=0) > 0.6).all()
    assert (np.mean(ratios, axis=0) < 1.4).all()


def test_the_prior_is_found_again_in_what_it_made() -> None:
    lattice, seen, _, _ = drawn(8)
    start = typical_prior(lattice)
    found = likeliest_prior(seen, start, lattice, 500).numbers
    ratio = found[[0, 2, 3, 4]] / PRIOR[[0, 2, 3, 4]]
    assert (ratio > 0.5).all()
    assert (ratio < 2.0).all()


def test_a_bend_runs_on_beyond_what_is_seen() -> None:
    points, normals = blade_like(np.random.default_rng(5), 1500)
    lattice = lattice_over(points, 200)
    bend = np.column_stack([0.002 * points[:, 2], 1e-4 * points[:, 2] ** 2, np.zeros(len(points))])
    along_mm = np.einsum("nj,nj->n", bend, normals)
    seen = points[:, 2] < 50.0
    sample = sample_of(lattice, points[seen], normals[seen], along_mm[seen], np.full(int(seen.sum()), 1e-6))
    wear = fit_wear(sample, likeliest_prior(sample, typical_prior(lattice), lattice, 400), lattice)
    error_mm = wear.freeform.along(points, normals) - along_mm
    assert np.abs(error_mm[seen]).max() < 1e-3
    assert np.abs(error_mm).max() < 0.02
    far = np.array([[0.0, 0.0, 400.0]])
    np.testing.assert_allclose(wear.freeform.shift(far)[0], 0.0, atol=1e-12)


def log_likelihood(sample: Sample, prior: Prior) -> float:
    """That of the displacements, by numpy alone."""
    matrix = sum(slow_covariance(sample, sample, prior.numbers)) + np.diag(sample.variance_mm2)
    misfit = sample.value_mm @ np.linalg.solve(matrix, sample.value_mm)
    return float(-0.5 * (misfit + np.linalg.slogdet(matrix)[1]))


def test_rivals_of_the_prior_are_hardly_less_likely_and_their_doubt_grows_beyond() -> None:
    lattice, seen, whole, _ = drawn(1)
    prior = likeliest_prior(seen, Prior.of(PRIOR), lattice, 500)
    best = log_likelihood(seen, prior)
    lost = sorted(best - log_likelihood(seen, rival) for rival in rival_priors(seen, prior, lattice, 500))
    assert lost[0] > 0.25  # one standard deviation costs a half
    assert lost[4] < 0.9
    assert lost[5] < 5.0  # the loosest direction is no parabola
    wear = fit_wear(seen, prior, lattice)
    points, normals = whole.places_mm @ lattice.axes, whole.normals @ lattice.axes
    doubt_mm = wear.doubt_mm(points, normals, 500)
    beyond = whole.places_mm[:, 2] > seen.places_mm[:, 2].max() + 5.0
    assert doubt_mm[beyond].mean() > 3.0 * doubt_mm[~beyond].mean()


def test_back_substitution_solves_the_transposed_band() -> None:
    rng = np.random.default_rng(12)
    bands = rng.normal(size=(40, 6)) + 4.0 * (np.arange(6) == 0)
    lower = sum(np.diag(bands[: 40 - k, k], -k) for k in range(6))
    right = rng.normal(size=(40, 3))
    np.testing.assert_allclose(lower.T @ back_substitute(bands, right), right, atol=1e-10)


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
            plate_over(nodes),
            points,
            normals,
            seen,
            np.full(len(points), 0.01),
            np.ones(len(points)),
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
