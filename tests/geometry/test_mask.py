"""The damage mask on a plate whose damage is known."""

import numpy as np
import pytest

from geometry.blade.nominal import NominalSettings, prepare_nominal
from geometry.errors import BadInput
from geometry.kernels.neighbours import k_nearest
from geometry.registration.mask import MaskSettings, damaged, form_of, ringed
from geometry.registration.register import mask_damage
from geometry.robust import robust_sigma
from geometry.types import Cloud
from tests.geometry import blades
from tests.geometry.poses import in_place


def plate(rng, sigma_mm):
    """Points of a 20 mm plate, their noisy residuals and the depth of a pit of 3 mm radius in its middle."""
    points = np.column_stack([rng.uniform(-10, 10, (8000, 2)), np.zeros(8000)])
    depth = 0.3 * np.maximum(0.0, 1.0 - np.hypot(*points[:, :2].T) / 3.0)
    return points, rng.normal(scale=sigma_mm, size=8000) - depth, depth


def flagged(residual, neighbours, floor_mm):
    """Damage and the ring around it."""
    return ringed(damaged(residual, neighbours, floor_mm, MaskSettings()), neighbours, MaskSettings())


def test_robust_sigma_is_the_sigma_and_ignores_outliers():
    values = np.random.default_rng(1).normal(3.0, 0.5, 20_000)
    assert robust_sigma(values) == pytest.approx(0.5, rel=0.02)
    assert robust_sigma(np.concatenate([values, np.full(1000, 1e6)])) == pytest.approx(0.53, rel=0.05)


@pytest.mark.parametrize("sigma", [0.0, 0.015, 0.03])
def test_damage_deeper_than_three_sigma_is_found_and_little_else(sigma):
    points, residual, depth = plate(np.random.default_rng(2), sigma)
    flags = flagged(residual, k_nearest(points, 17)[0], max(sigma, 1e-4) / 4.0)
    assert flags[depth > 3.0 * max(sigma, 0.001)].mean() > 0.99
    assert flags[np.hypot(*points[:, :2].T) > 4.0].mean() < 0.005


def test_beside_a_steep_rim_only_the_nearest_points_are_lost():
    points, residual, _ = plate(np.random.default_rng(4), 0.01)
    radius = np.hypot(*points[:, :2].T)
    residual = np.where(radius < 4.0, residual - 2.0, residual)
    nearest, apart = k_nearest(points, 17)
    flags = flagged(residual, nearest, 0.0025)
    assert flags[radius < 4.0].all()
    reach = 4.0 + np.quantile(apart[:, 5], 0.99)
    assert flags[radius > reach].mean() < 0.001


def test_excess_counts_as_much_as_missing():
    points, residual, _ = plate(np.random.default_rng(3), 0.015)
    neighbours, _ = k_nearest(points, 17)
    up, down = (flagged(r, neighbours, 0.004) for r in (residual, -residual))
    assert np.array_equal(up, down)


def wedge(rng):
    """Both sides of a 40 x 30 mm plate, 1 mm thick, and their normals."""
    top = np.column_stack([rng.uniform([-20, -15], [20, 15], (10_000, 2)), np.full(10_000, 0.5)])
    points = np.concatenate([top, top * [1.0, 1.0, -1.0]])
    return points, np.sign(points[:, 2:]) * [0.0, 0.0, 1.0]


def test_form_is_the_smooth_part_on_each_side_and_leaves_the_damage():
    rng = np.random.default_rng(5)
    points, normals = wedge(rng)
    x, y, z = points.T
    bent = 0.08 * np.cos(0.06 * x) * np.sin(0.08 * y + 0.5) * np.sign(z) + 0.01
    pit = np.where((np.hypot(x, y) < 3.0) & (z > 0), 0.4, 0.0)
    form = form_of(points, normals, bent - pit + rng.normal(scale=0.01, size=len(points)), MaskSettings())
    assert np.sqrt(np.mean((form - bent) ** 2)) < 0.004
    assert np.abs(form - bent)[pit > 0.0].max() < 0.03


def blunt_plate(rng):
    """Both sides of a plate 40 mm wide, 80 high and 0.4 thick, and its round edge at x = 20; normals."""
    turn = rng.uniform(-np.pi / 2.0, np.pi / 2.0, 400)
    look = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(400)])
    edge = [20.0, 0.0, 0.0] + 0.2 * look + np.column_stack([np.zeros((400, 2)), rng.uniform(0.0, 80.0, 400)])
    up = np.where(rng.random(50_000) < 0.5, 1.0, -1.0)
    sides = np.column_stack([rng.uniform(-20.0, 20.0, 50_000), 0.2 * up, rng.uniform(0.0, 80.0, 50_000)])
    normals = np.column_stack([np.zeros(50_000), up, np.zeros(50_000)])
    return np.concatenate([sides, edge]), np.concatenate([normals, look])


def test_a_thin_edge_has_a_form_too():
    """Sections that moved along their chord by up to 0.05 show it at the edge: 400 of 50,000 points."""
    rng = np.random.default_rng(7)
    points, normals = blunt_plate(rng)
    moved = 0.05 * np.sin(2.0 * np.pi * points[:, 2] / 80.0) * normals[:, 0]
    form = form_of(points, normals, moved + rng.normal(scale=0.005, size=len(points)), MaskSettings())
    assert np.sqrt(np.mean((form - moved)[normals[:, 0] > 0.0] ** 2)) < 0.008


def test_what_a_thin_edge_has_lost_over_a_length_is_no_form():
    """Eroded by 0.14 over a fifth of its length, on a plate that is hardly worn."""
    rng = np.random.default_rng(7)
    points, normals = blunt_plate(rng)
    lost = 0.14 * np.clip(9.0 - np.abs(points[:, 2] - 40.0), 0.0, 1.0) * np.maximum(normals[:, 0], 0.0)
    form = form_of(points, normals, -lost + rng.normal(scale=0.01, size=len(points)), MaskSettings())
    assert np.abs(form[lost > 0.1]).mean() < 0.04


def test_form_of_a_surface_that_is_nowhere_near_is_nothing():
    points, normals = wedge(np.random.default_rng(6))
    far = np.where(np.arange(len(points)) % 2, 3.0, -3.0)
    settings = MaskSettings(form_nodes=100, form_window=100, form_points=200)
    assert np.abs(form_of(points[:80], normals[:80], far[:80], settings)).max() == 0.0


@pytest.mark.parametrize(
    "wrong",
    [
        {"low": 9.0},
        {"low": 0.0},
        {"neighbours": 2},
        {"form_mm": 0.0},
        {"own": 0.0},
        {"usual": -1.0},
        {"ring": -1},
        {"form_window": 5},
    ],
)
def test_settings_that_contradict_themselves_are_refused(wrong):
    with pytest.raises(BadInput, match="mask"):
        MaskSettings(**wrong)


def flagged_of_a_wavy_broken_blade(waves, amplitude_mm, seed):
    """A blade with waves round its sections and the trailing corner of its tip gone, and what is flagged."""
    blade, rng = blades.Blade(), np.random.default_rng(seed)
    scan = blades.with_tip_cut(blades.scan(blade, 6.5, rng), blade, 28.0, rng, 1.1)
    wave_mm = amplitude_mm * np.sin(2.0 * np.pi * waves * scan.points_mm[:, 0] / blade.chord_mm)
    points_mm = scan.points_mm + wave_mm[:, None] * scan.normals
    settings = NominalSettings(z_min_mm=0.0, z_max_mm=blade.height_mm)
    count = len(points_mm)
    cloud = Cloud(points_mm=points_mm, sigma_mm=np.full(count, 0.001), view=np.zeros(count, np.int64))
    return scan, mask_damage(cloud, in_place(), prepare_nominal(blades.mesh(blade), settings))


def test_the_form_of_a_small_end_face_is_not_taken_for_damage():
    """Three waves along a tip face that a break has left half of; it may be all that holds the height."""
    scan, flags = flagged_of_a_wavy_broken_blade(waves=3, amplitude_mm=0.03, seed=6)
    sound = (scan.depth_mm == 0.0) & (scan.normals[:, 2] > 0.9)
    assert sound.sum() > 100
    assert flags[sound].mean() < 0.15
    assert flags[scan.depth_mm > 0.1].mean() > 0.98


def test_the_form_is_known_right_up_to_a_break():
    scan, flags = flagged_of_a_wavy_broken_blade(waves=6, amplitude_mm=0.03, seed=7)
    assert flags[scan.depth_mm == 0.0].mean() < 0.01
    assert flags[scan.depth_mm > 0.1].mean() > 0.99
