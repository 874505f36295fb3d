"""The tensor spline's sums, band algebra and chosen smoothness, against dense twins."""

import numpy as np
import pytest
from scipy.interpolate import BSpline

from geometry.kernels.profile_spline import Penalty, curvature_penalty, fit_spline, gather, solve, stencil
from geometry.kernels.tensor_spline import band_inverse, cubic_weights, tensor_sums, tensor_values

P, Q = 16, 5


def dense_basis(u, v):
    """(n, P, Q): the tensor basis from scipy's B-splines, one coefficient at a time."""
    bump = BSpline.basis_element(np.arange(5.0), extrapolate=False)
    along = np.stack(
        [np.nansum([np.nan_to_num(bump(u - i + 3 + turn)) for turn in (-P, 0, P)], axis=0) for i in range(P)]
    )
    across = np.stack([np.nan_to_num(bump(v - k + 3)) for k in range(Q)])
    return np.einsum("in,kn->nik", along, across)


def dense(matrix):
    """A stencil matrix as (P Q, P Q)."""
    out = np.zeros((P, Q, P, Q))
    for i in range(P):
        for d in range(4):
            out[i, :, (i + d) % P, :] = matrix[i, d]
            out[(i + d) % P, :, i, :] = matrix[i, d].T
    return out.reshape(P * Q, P * Q)


@pytest.fixture
def data():
    rng = np.random.default_rng(5)
    n = 400
    u, v = rng.uniform(0.0, P, n), rng.uniform(0.0, Q - 3, n)
    y = np.sin(2 * np.pi * u / P) + 0.2 * v + rng.normal(0.0, 0.1, n)
    weight, columns = rng.uniform(0.5, 2.0, n), rng.normal(size=(n, 2))
    return u, v, y + columns @ np.array([0.3, -0.2]), weight, columns


@pytest.fixture
def penalty() -> Penalty:
    centre = np.cumsum(np.random.default_rng(2).uniform(0.5, 1.5, P))
    return curvature_penalty(centre, float(centre[-1] + 1.0), np.arange(P) % 2, Q, 2.0)


def dense_penalties(penalty):
    full = [penalty.matrix(np.eye(3)[j]) for j in range(3)]
    return [dense(m) for m in full]


def test_sums_equal_those_of_the_dense_basis(data):
    u, v, y, weight, columns = data
    basis = dense_basis(u, v).reshape(-1, P * Q)
    gram, right, cross = tensor_sums(u, v, y, weight, columns, (P, Q))
    np.testing.assert_allclose(dense(gram), basis.T @ (basis * weight[:, None]), atol=1e-10)
    np.testing.assert_allclose(right.ravel(), basis.T @ (weight * y), atol=1e-10)
    np.testing.assert_allclose(cross.reshape(P * Q, -1), basis.T @ (columns * weight[:, None]), atol=1e-10)


def test_values_equal_those_of_the_dense_basis(data):
    u, v, *_ = data
    c = np.random.default_rng(1).normal(size=(P, Q))
    np.testing.assert_allclose(tensor_values(u, v, c), np.tensordot(dense_basis(u, v), c, 2), atol=1e-12)


def test_cubic_weights_share_out_one():
    t = np.random.default_rng(0).uniform(0.0, 9.0, 50)
    weights = cubic_weights(t, t.astype(np.int64))
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    assert (weights >= 0.0).all()


def test_band_inverse_equals_the_dense_inverse_inside_the_band():
    rng = np.random.default_rng(3)
    lower = np.tril(rng.normal(size=(30, 30)))
    lower[np.tri(30, k=-5, dtype=bool)] = 0.0
    lower[np.diag_indices(30)] = rng.uniform(1.0, 2.0, 30)
    factor = np.zeros((5, 30))
    for d in range(5):
        factor[d, : 30 - d] = np.diag(lower, -d)
    inverse = band_inverse(factor)
    expected = np.linalg.inv(lower @ lower.T)
    for d in range(5):
        np.testing.assert_allclose(inverse[d, : 30 - d], np.diag(expected, -d), rtol=1e-9, atol=1e-12)


def test_fold_and_unfold_are_inverse():
    values = np.arange(P * Q * 3, dtype=float).reshape(P, Q, 3)
    layout = stencil(P, Q)
    np.testing.assert_array_equal(layout.unfold(layout.fold(values)), values)


def test_penalties_see_no_bending_in_a_constant_and_in_a_slope_across(penalty):
    flat = np.ones((P, Q, 1)) + np.arange(Q)[None, :, None]
    np.testing.assert_allclose(penalty.times(flat), 0.0, atol=1e-9)


def test_penalty_products_and_traces_equal_dense_ones(penalty):
    c = np.random.default_rng(4).normal(size=(P, Q, 2))
    full = dense_penalties(penalty)
    for product, matrix in zip(penalty.times(c), full, strict=True):
        np.testing.assert_allclose(product.reshape(-1, 2), matrix @ c.reshape(-1, 2), atol=1e-9)
    root = np.random.default_rng(6).normal(size=(P * Q, P * Q))
    inverse = (root @ root.T).reshape(P, Q, P, Q)
    inside = np.stack([[inverse[i, :, (i + d) % P, :] for d in range(4)] for i in range(P)])
    expected = [np.trace(inverse.reshape(P * Q, -1) @ matrix) for matrix in full]
    np.testing.assert_allclose(penalty.traces(inside), expected, rtol=1e-9)


def test_effective_dimensions_equal_those_of_the_pseudo_inverse(penalty):
    strength = np.array([2.0, 0.3, 5.0])
    full = dense_penalties(penalty)
    total = sum(s * m for s, m in zip(strength, full, strict=True))
    pseudo = np.linalg.pinv(total, rcond=1e-10, hermitian=True)
    expected = [s * np.trace(pseudo @ m) for s, m in zip(strength, full, strict=True)]
    np.testing.assert_allclose(penalty.effective(strength), expected, rtol=1e-6)


def test_solution_and_covariance_equal_the_dense_ones(data, penalty):
    u, v, y, weight, columns = data
    strength = np.array([0.1, 0.2, 0.5])
    fit = solve(gather(u, v, y, weight, columns, stencil(P, Q)), penalty, strength)
    design = np.hstack([dense_basis(u, v).reshape(-1, P * Q), columns])
    stiff = np.zeros((P * Q + 2, P * Q + 2))
    stiff[: P * Q, : P * Q] = sum(s * m for s, m in zip(strength, dense_penalties(penalty), strict=True))
    system = design.T @ (design * weight[:, None]) + stiff
    solution = np.linalg.solve(system, design.T @ (weight * y))
    np.testing.assert_allclose(fit.coefficients.ravel(), solution[: P * Q], atol=1e-6)
    np.testing.assert_allclose(fit.free, solution[P * Q :], atol=1e-7)
    inverse = np.linalg.inv(system)
    residual = y - design @ solution
    dimensions = np.trace(inverse @ (system - stiff))
    scale = (weight * residual**2).sum() / (len(y) - dimensions)
    assert fit.scale == pytest.approx(scale, rel=1e-6)
    ask = np.random.default_rng(8).normal(size=(P * Q + 2, 3))
    covariance = fit.covariance(ask[: P * Q].reshape(P, Q, 3), ask[P * Q :])
    np.testing.assert_allclose(covariance, scale * ask.T @ inverse @ ask, rtol=1e-4)


def test_variances_are_the_diagonal_of_the_covariance(data, penalty):
    """Also once functions are held."""
    u, v, y, weight, columns = data
    fit = solve(gather(u, v, y, weight, columns, stencil(P, Q)), penalty, np.array([0.1, 0.2, 0.5]))
    rng = np.random.default_rng(7)
    held = fit.held(rng.normal(size=(P, Q, 2)), np.array([1e-4, 2e-4]))
    first, along, across = np.arange(P), rng.uniform(0.0, 1.0, (P, 4)), rng.uniform(0.0, 1.0, Q)
    free = rng.normal(size=(2, P))
    spline = np.zeros((P, Q, P))
    for n in range(P):
        for k in range(4):
            spline[(n + k) % P, :, n] = along[n, k] * across
    for each in (fit, held):
        expected = np.diag(each.covariance(spline, free))
        np.testing.assert_allclose(each.variances(first, along, across, free), expected, rtol=1e-8)


def restricted_likelihood(strength, data, penalty):
    """Minus twice the log restricted likelihood, noise profiled out, by dense algebra."""
    u, v, y, weight, columns = data
    design = np.hstack([dense_basis(u, v).reshape(-1, P * Q), columns])
    stiff = sum(s * m for s, m in zip(strength, dense_penalties(penalty), strict=True))
    system = design.T @ (design * weight[:, None])
    system[: P * Q, : P * Q] += stiff
    solution = np.linalg.solve(system, design.T @ (weight * y))
    c = solution[: P * Q]
    misfit = (weight * (y - design @ solution) ** 2).sum() + c @ stiff @ c
    free = len(y) - 2 - 2
    eigen = np.linalg.eigvalsh(stiff)[2:]
    return free * np.log(misfit) + np.linalg.slogdet(system)[1] - np.log(eigen).sum()


def test_chosen_strengths_are_near_the_best_of_restricted_likelihood(data, penalty):
    u, v, y, weight, columns = data
    fit = fit_spline(gather(u, v, y, weight, columns, stencil(P, Q)), penalty, np.ones(3), rounds=40)
    found = restricted_likelihood(fit.strength, data, penalty)
    for j in range(3):
        for factor in (0.25, 4.0):
            other = fit.strength * np.where(np.arange(3) == j, factor, 1.0)
            assert found <= restricted_likelihood(other, data, penalty) + 0.35  # what is out of balance
