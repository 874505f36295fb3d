"""Rigid motions against their definitions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from geometry.errors import BadInput
from geometry.transforms import about_z, apply, check_rigid, exp, inverse, log, rigid, rotate

seeds = st.integers(0, 10**6)


def random_twist(seed):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.5, 1.5, 6), rng.uniform(-50, 50, 3)


@given(seeds)
def test_log_takes_exp_back(seed):
    twist, pivot = random_twist(seed)
    assert np.allclose(log(exp(twist, pivot), pivot), twist, atol=1e-9)


@given(seeds)
def test_the_rotation_of_exp_is_the_matrix_exponential(seed):
    twist, pivot = random_twist(seed)
    x, y, z = twist[:3]
    assert np.allclose(
        exp(twist, pivot)[:3, :3], expm(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])), atol=1e-12
    )


@given(seeds)
def test_exp_moves_the_pivot_by_the_shift_alone(seed):
    twist, pivot = random_twist(seed)
    assert np.allclose(apply(exp(twist, pivot), pivot[None])[0], pivot + twist[3:], atol=1e-10)


@given(seeds)
def test_inverse_undoes(seed):
    T = exp(*random_twist(seed))
    points = np.random.default_rng(seed).normal(size=(5, 3))
    assert np.allclose(apply(inverse(T), apply(T, points)), points, atol=1e-10)
    assert np.allclose(inverse(T) @ T, np.eye(4), atol=1e-10)


def test_turn_about_z_is_counter_clockwise():
    assert np.allclose(apply(about_z(90.0), np.array([[1.0, 0.0, 5.0]])), [[0.0, 1.0, 5.0]])


def test_directions_are_not_translated():
    T = rigid(about_z(90.0)[:3, :3], np.array([7.0, 8.0, 9.0]))
    assert np.allclose(rotate(T, np.array([[1.0, 0.0, 0.0]])), [[0.0, 1.0, 0.0]])


@pytest.mark.parametrize(
    "spoil",
    [
        lambda T: T * 1.001,
        lambda T: T @ np.diag([1.0, 1.0, -1.0, 1.0]),
        lambda T: T + np.nan,
        lambda T: T[:3],
        lambda T: T + np.outer([0, 0, 0, 1], [0, 0, 1e-3, 0]),
    ],
)
def test_what_is_no_rigid_motion_is_refused(spoil):
    with pytest.raises(BadInput, match="axis: not a proper rigid motion"):
        check_rigid(spoil(about_z(30.0)), "axis")
