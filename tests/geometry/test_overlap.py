"""The axis on which views agree, against the true one, and the view that disagrees, by name."""

from dataclasses import replace

import numpy as np
import pytest

from geometry.errors import CannotMeasure
from geometry.kernels.overlap import heights_over_others
from geometry.scan.overlap import refine_axis
from geometry.transforms import about_z, exp, inverse, log, rigid
from geometry.types import Floats, View
from tests.geometry.test_fuse import AXIS, views

NOISE_MM = 0.015
PIVOT = np.zeros(3)
SIGMAS = np.array([np.deg2rad(AXIS.sigma_tilt_deg)] * 2 + [AXIS.sigma_offset_mm] * 2)


def knocked(error):
    """The calibration of the test cell when tilt (rad) and offset (mm) of the axis are in error."""
    twist = np.array([error[0], error[1], 0.0, error[2], error[3], 0.0])
    return replace(AXIS, T_scanner_table0=AXIS.T_scanner_table0 @ exp(twist, PIVOT))


def test_the_axis_is_found_within_its_stated_uncertainty_and_better_than_it_was_known():
    pulls, left_mm = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        taken = views(rng, NOISE_MM, {})
        error = rng.normal(size=4) * np.array(
            [*[np.deg2rad(AXIS.sigma_tilt_deg)] * 2, *[AXIS.sigma_offset_mm] * 2]
        )
        refined = refine_axis(taken, knocked(error), NOISE_MM)
        left = log(inverse(AXIS.T_scanner_table0) @ refined.axis.T_scanner_table0, PIVOT)
        left_mm.append(left[3:5])
        pulls.append(left[3:5] / refined.axis.sigma_offset_mm)
        assert refined.surface_mm < AXIS.sigma_offset_mm + 105.0 * np.deg2rad(AXIS.sigma_tilt_deg)
    assert np.sqrt(np.mean(np.square(pulls))) < 1.5
    assert np.sqrt(np.mean(np.square(left_mm))) < 0.7 * AXIS.sigma_offset_mm


def test_a_knocked_axis_is_told_in_sigmas_of_its_calibration():
    taken = views(np.random.default_rng(7), NOISE_MM, {})
    assert refine_axis(taken, knocked([0.0, 0.0, 0.0, 0.0]), NOISE_MM).moved_sigmas < 3.0
    assert refine_axis(taken, knocked([0.0, 0.0, 0.06, 0.0]), NOISE_MM).moved_sigmas > 6.0


def test_an_axis_that_is_known_exactly_is_left_alone():
    exact = replace(AXIS, sigma_offset_mm=0.0, sigma_tilt_deg=0.0)
    refined = refine_axis(views(np.random.default_rng(8), NOISE_MM, {}), exact, NOISE_MM)
    assert np.allclose(refined.axis.T_scanner_table0, exact.T_scanner_table0, atol=1e-12)
    assert refined.surface_mm == 0.0


def test_agreeing_views_show_noise_and_no_bias():
    found = refine_axis(views(np.random.default_rng(2), NOISE_MM, {}), AXIS, NOISE_MM).overlaps
    assert len(found) == 8
    for overlap in found:
        assert overlap.points > 500
        assert overlap.rms_mm < 0.03
        assert overlap.bias_mm < 0.004


@pytest.mark.parametrize("size_mm", [0.03, 0.1])
def test_the_view_that_disagrees_is_named(size_mm):
    shifted = views(np.random.default_rng(3), 0.015, {5: np.array([0.0, 0.0, size_mm])})
    found = refine_axis(shifted, AXIS, NOISE_MM).overlaps
    worst = max(found, key=lambda overlap: overlap.bias_mm)
    assert worst.view == 5
    assert worst.bias_mm > 0.4 * size_mm


def test_no_points_have_no_axis():
    with pytest.raises(CannotMeasure, match="without a point"):
        refine_axis([View(index=0, angle_deg=0.0, points_mm=np.zeros((0, 3)))], AXIS, NOISE_MM)


def test_a_single_view_has_no_overlap():
    one = views(np.random.default_rng(4), 0.0, {})[:1]
    refined = refine_axis(one, AXIS, NOISE_MM)
    assert refined.overlaps == ()
    assert np.array_equal(refined.axis.T_scanner_table0, AXIS.T_scanner_table0)
    assert refined.surface_mm >= AXIS.sigma_offset_mm


def slow_height(i, error, points, normals, angle_rad, view, nearest):
    """By definition, once an error of the axis has moved every point."""
    moved = np.array(
        [_displaced(point, angle, error) for point, angle in zip(points, angle_rad, strict=True)]
    )
    own = view[nearest[i, 1:]] == view[i]
    near = moved[nearest[i, 1:]]
    return (near[own].mean(axis=0) - near[~own].mean(axis=0)) @ normals[i]


def _displaced(point: Floats, angle_rad: float, error: Floats) -> Floats:
    turn = about_z(np.rad2deg(angle_rad))
    shift = rigid(np.eye(3), np.array([error[2], error[3], 0.0]))
    tilt = np.eye(4)
    tilt[:3, :3] += np.array([[0, 0, error[1]], [0, 0, -error[0]], [-error[1], error[0], 0]])
    moved = np.linalg.inv(turn) @ np.linalg.inv(tilt @ shift) @ turn @ np.append(point, 1.0)
    return moved[:3]


def test_the_kernel_is_its_definition():
    rng = np.random.default_rng(9)
    points = rng.normal(size=(30, 3)) * 5.0
    normals = rng.normal(size=(30, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    view = rng.integers(3, size=30)
    angle_rad = np.array([0.3, 1.7, 4.0])[view]
    nearest = np.argsort(np.linalg.norm(points[:, None] - points, axis=2), axis=1)[:, :12]
    given = (points, normals, angle_rad, view, nearest)
    height, felt, apart, fewer = heights_over_others(*given)
    own = (view[nearest[:, 1:]] == view[:, None]).sum(axis=1)
    assert np.array_equal(fewer, np.minimum(own, 11 - own))
    assert (apart >= np.abs(height)).all()
    for i in np.flatnonzero(fewer):
        assert height[i] == pytest.approx(slow_height(i, np.zeros(4), *given), abs=1e-12)
        slopes = [(slow_height(i, e, *given) - slow_height(i, -e, *given)) / 2e-3 for e in 1e-3 * np.eye(4)]
        assert felt[i] == pytest.approx(slopes, abs=1e-5)
