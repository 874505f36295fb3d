"""The axis against one that was put in."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geometry.errors import BadInput, CannotMeasure
from geometry.scan.calibrate import AxisCalibration, calibrate_axis, find_sphere
from geometry.transforms import about_z, apply, inverse, rigid

T_SCANNER_TABLE = rigid(
    Rotation.from_euler("xyz", [92.0, 3.0, -20.0], degrees=True).as_matrix(), np.array([5.0, -8.0, 310.0])
)


def centres(angles_deg, noise_mm, rng, sphere_mm=(60.0, 10.0, 25.0)):
    seen = [apply(T_SCANNER_TABLE @ about_z(a), np.array([sphere_mm]))[0] for a in angles_deg]
    return np.array(seen) + rng.normal(scale=noise_mm, size=(len(seen), 3)) if noise_mm else np.array(seen)


def axis_error(found):
    """Tilt, deg, and distance, mm, of the found axis from the true one, at the true origin's height."""
    tilt = np.rad2deg(np.arccos(np.clip(found.T_scanner_table0[:3, 2] @ T_SCANNER_TABLE[:3, 2], -1, 1)))
    off = inverse(T_SCANNER_TABLE) @ found.T_scanner_table0[:, 3]
    return tilt, np.hypot(off[0], off[1])


def test_exact_centres_give_the_exact_axis():
    angles = np.arange(0.0, 360.0, 30.0)
    tilt, off = axis_error(calibrate_axis(centres(angles, 0.0, np.random.default_rng(0)), angles))
    assert tilt < 1e-5
    assert off < 1e-9


def test_points_fused_with_the_found_axis_fall_together():
    angles = np.array([10.0, 95.0, 200.0, 290.0, 340.0])
    found = calibrate_axis(centres(angles, 0.0, np.random.default_rng(0)), angles)
    part = np.array([[3.0, 4.0, 50.0]])
    seen = [apply(T_SCANNER_TABLE @ about_z(a), part) for a in angles]
    back = [
        apply(inverse(found.T_scanner_table0 @ about_z(a)), p)[0] for a, p in zip(angles, seen, strict=True)
    ]
    assert np.ptp(back, axis=0).max() < 1e-9


def test_uncertainties_are_the_scatter_over_many_trials():
    angles, rng = np.arange(0.0, 360.0, 30.0), np.random.default_rng(1)
    trials = [calibrate_axis(centres(angles, 0.01, rng), angles) for _ in range(300)]
    errors = np.array([axis_error(found) for found in trials])
    tilt_sd, offset_sd = np.sqrt(np.mean(errors**2, axis=0) / 2.0)  # two components each
    assert np.mean([f.sigma_offset_mm for f in trials]) == pytest.approx(offset_sd, rel=0.15)
    assert np.mean([f.sigma_tilt_deg for f in trials]) == pytest.approx(tilt_sd, rel=0.15)


def test_a_circle_wants_five_angles():
    with pytest.raises(CannotMeasure, match="4 angles, 5 are needed"):
        calibrate_axis(centres([0, 90, 180, 270], 0.01, np.random.default_rng(2)), np.arange(4) * 90.0)


@pytest.mark.parametrize("angles", [[0, 10, 20, 30, 40, 50], [0, 0, 0, 0, 0, 0]])
def test_too_little_turn_is_no_calibration(angles):
    with pytest.raises(CannotMeasure, match="turn"):
        calibrate_axis(centres(angles, 0.01, np.random.default_rng(2)), np.array(angles, float))


def test_a_sphere_on_the_axis_is_no_calibration():
    angles = np.arange(0.0, 360.0, 30.0)
    with pytest.raises(CannotMeasure, match="circle"):
        calibrate_axis(centres(angles, 0.01, np.random.default_rng(3), (0.0, 0.0, 25.0)), angles)


def test_sphere_centre_from_a_noisy_cap():
    rng = np.random.default_rng(4)
    v = rng.normal(size=(20_000, 3))
    v = v[v[:, 2] > 0.4 * np.linalg.norm(v, axis=1)]
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    radius = 15.0 + rng.normal(scale=0.02, size=(len(v), 1))
    centre, rms = find_sphere(v * radius + [100.0, -20.0, 300.0], 15.0)
    assert np.linalg.norm(centre - [100.0, -20.0, 300.0]) < 0.004
    assert rms == pytest.approx(0.02, rel=0.05)


def test_a_plane_is_no_sphere():
    flat = np.column_stack([np.random.default_rng(5).uniform(-5, 5, (100, 2)), np.zeros(100)])
    with pytest.raises(CannotMeasure, match="plane"):
        find_sphere(flat, 10.0)


@pytest.mark.parametrize("sigma", [-1.0, np.nan, np.inf])
def test_an_uncertainty_that_is_no_number_is_refused(sigma):
    with pytest.raises(BadInput, match="uncertainties"):
        AxisCalibration(T_scanner_table0=np.eye(4), sigma_offset_mm=sigma, sigma_tilt_deg=0.0)
