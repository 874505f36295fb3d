"""Thinning and spline kernels against slow, plain twins."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.spatial import cKDTree

from geometry.kernels.rwlls import blend_curves, grow_domains, pull_back
from geometry.kernels.rwlls_spline import cubic_basis, fit_closed, fit_progressively, place_knots


def noisy_ring(seed, count=120, noise=0.02):
    """Points about an ellipse with normals a little off, random weights, and their neighbours."""
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, count))
    normals = np.column_stack([np.cos(angle) / 3.0, np.sin(angle)])
    normals += rng.normal(scale=0.02, size=normals.shape)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    points = np.column_stack([3.0 * np.cos(angle), np.sin(angle)])
    points = points + normals * rng.normal(scale=noise, size=count)[:, None]
    nearest = cKDTree(points).query(points, k=40)[1]
    return points, normals, rng.uniform(0.2, 1.0, count), nearest


def local(points, normals, i, members):
    away = points[members] - points[i]
    nx, ny = normals[i]
    return away @ [ny, -nx], away @ [nx, ny]


def slow_domain(points, normals, weights, nearest, i, limit):
    """The members and the coefficients of one point, each step a fit of its own."""
    x, _ = local(points, normals, i, nearest[i, 1:])
    right, left = (list(nearest[i, 1:][side]) for side in (x >= 0.0, x < 0.0))
    order = [i]
    while (len(order) % 2 == 1 and right) or (len(order) % 2 == 0 and left):
        order.append((right if len(order) % 2 == 1 else left).pop(0))
    kept = None
    for m in range(3, len(order) + 1):
        x, y = local(points, normals, i, order[:m])
        root = np.sqrt(weights[order[:m]])
        design = np.vander(x, 3, increasing=True)
        c = np.linalg.lstsq(design * root[:, None], y * root, rcond=None)[0]
        if m > 3 and np.sqrt(np.mean((design @ c - y) ** 2)) > limit:
            break
        kept = order[:m], c
    return kept


@pytest.mark.parametrize("seed", range(3))
def test_domains_are_those_of_a_fit_a_step(seed):
    ring = noisy_ring(seed)
    members, size, curves = grow_domains(*ring, 0.02)
    for i in range(len(size)):
        order, c = slow_domain(*ring, i, 0.02)
        assert members[i, : size[i]].tolist() == list(order)
        assert np.allclose(curves[i], c, rtol=1e-5, atol=1e-6)


def test_points_in_one_place_make_no_curve():
    points = np.zeros((6, 2))
    normals = np.tile([0.0, 1.0], (6, 1))
    nearest = np.array([np.roll(np.arange(6), -i) for i in range(6)])
    members, size, curves = grow_domains(points, normals, np.ones(6), nearest, 0.1)
    assert (size == 0).all()
    thin, _, _, count = blend_curves(points, normals, members, size, curves)
    assert (count == 0).all()
    assert (thin == points).all()


def test_thinned_points_are_the_mean_of_all_curves_through_them():
    points, normals, weights, nearest = noisy_ring(5)
    members, size, curves = grow_domains(points, normals, weights, nearest, 0.02)
    thin, direction, spread, count = blend_curves(points, normals, members, size, curves)
    projections = [[] for _ in points]
    directions = [[] for _ in points]
    for i in range(len(points)):
        nx, ny = normals[i]
        for q in members[i, : size[i]]:
            x, _ = local(points, normals, i, [q])
            c0, c1, c2 = curves[i]
            y = c0 + c1 * x + c2 * x * x
            projections[q].append(points[i] + x * np.array([ny, -nx]) + y * normals[i])
            slope = (c1 + 2.0 * c2 * x)[0]
            direction_q = (normals[i] - slope * np.array([ny, -nx])) / np.hypot(1.0, slope)
            directions[q].append(direction_q * np.sign(direction_q @ normals[q]))
    assert count.tolist() == [len(p) for p in projections]
    assert np.allclose(thin, [np.mean(p, axis=0) for p in projections])
    total = np.array([np.sum(d, axis=0) for d in directions])
    assert np.allclose(direction, total / np.linalg.norm(total, axis=1)[:, None])
    along = [np.std((np.array(p) - points[q]) @ normals[q]) for q, p in enumerate(projections)]
    assert np.allclose(spread, along, atol=1e-7)


def test_noise_is_pulled_back_through_the_thinning():
    points, normals, weights, nearest = noisy_ring(6)
    members, size, _ = grow_domains(points, normals, weights, nearest, 0.02)
    n = len(points)
    smoother, count = np.zeros((n, n)), np.zeros(n)
    for i in range(n):
        inside = members[i, : size[i]]
        design = np.vander(local(points, normals, i, inside)[0], 3, increasing=True)
        weighted = design.T * weights[inside]
        smoother[np.ix_(inside, inside)] += design @ np.linalg.solve(weighted @ design, weighted)
        count[inside] += 1.0
    functions = np.random.default_rng(7).normal(size=(n, 3))
    expected = (smoother / count[:, None]).T @ functions
    assert np.allclose(pull_back(points, normals, weights, members, size, functions), expected, atol=1e-7)


def parameters(seed, count=60):
    t = np.sort(np.random.default_rng(seed).uniform(0.0, 1.0, count))
    return t - t[0]


@pytest.mark.parametrize("m", [3, 4, 5, 6, 7, 8, 20])
def test_the_basis_is_that_of_scipy(m):
    t = parameters(m)
    knots = place_knots(t, m)
    first, values = cubic_basis(knots, t)
    dense = np.zeros((len(t), m + 3))
    dense[np.arange(len(t))[:, None], first[:, None] + np.arange(4)] = values
    assert np.allclose(dense, BSpline.design_matrix(t, knots, 3).toarray(), atol=1e-13)
    assert all(((t >= a) & (t < b)).any() for a, b in pairwise(knots[3:-3]))


@pytest.mark.parametrize("m", [3, 4, 5, 6, 7, 8, 20])
def test_the_closed_fit_is_that_of_dense_least_squares(m):
    t = parameters(m + 50)
    points = np.random.default_rng(m).normal(size=(len(t), 2))
    knots, control, rms = fit_closed(t, points, m)
    open_basis = BSpline.design_matrix(t, knots, 3).toarray()
    closed = open_basis[:, :m].copy()
    for k in range(3):
        closed[:, k % m] += open_basis[:, m + k]
    expected = np.linalg.lstsq(closed, points, rcond=None)[0]
    assert np.allclose(control, expected, atol=1e-8)
    assert rms == pytest.approx(np.sqrt(((closed @ expected - points) ** 2).sum(axis=1).mean()))


def test_the_closed_spline_joins_with_its_curvature():
    t = parameters(1)
    points = np.random.default_rng(2).normal(size=(len(t), 2))
    knots, control, _ = fit_closed(t, points, 9)
    spline = BSpline(knots, np.vstack([control, control[:3]]), 3)
    for order in (0, 1, 2):
        assert np.allclose(spline.derivative(order)(0.0), spline.derivative(order)(1.0 - 1e-12), atol=1e-6)


def test_segments_grow_until_the_fit_is_near_enough_and_no_more():
    angle = 2.0 * np.pi * np.arange(400) / 400
    points = np.column_stack([20.0 * np.cos(angle), 3.0 * np.sin(angle)])
    t = np.arange(400) / 400
    knots, control, rms = fit_progressively(t, points, 0.01, 100)
    assert rms < 0.01
    assert len(control) > 3
    assert fit_closed(t, points, len(control) - 1)[2] >= 0.01
    assert len(knots) == len(control) + 7


def test_where_nothing_is_near_enough_the_most_segments_are_given():
    t, points = parameters(3), np.random.default_rng(3).normal(size=(60, 2))
    _, control, rms = fit_progressively(t, points, 1e-6, 10)
    assert len(control) == 10
    assert rms == fit_closed(t, points, 10)[2]
