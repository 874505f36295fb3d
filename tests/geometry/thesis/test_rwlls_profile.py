"""Profiles reconstructed by the thesis' method, against curves known from their formulas."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree

from geometry.errors import BadInput, CannotMeasure
from geometry.thesis.rwlls_profile import RwllsSettings, reconstruct_thesis, take_into_plane
from tests.geometry.airfoils import Part, centroid_of

Z = 52.5
SPACING_MM, NOISE_MM = 0.12, 0.015
PART = Part()
DENSE = np.arange(4096) / 4096


def scan(seed, noise_mm=NOISE_MM, spacing_mm=SPACING_MM):
    return PART.scan(np.random.default_rng(seed), Z - 1.0, Z + 1.0, spacing_mm, noise_mm)


@cache
def profile(seed=1, noise_mm=NOISE_MM):
    return reconstruct_thesis(scan(seed, noise_mm), Z, max(noise_mm, 0.001) / np.sqrt(3.0))


def off_mm(curve):
    """Distance of points to the true section, whose own points are 0.02 mm apart."""
    true = PART.section(Z)
    near = cKDTree(true).query(curve)[1]
    ahead = np.roll(true, -1, axis=0) - np.roll(true, 1, axis=0)
    normals = np.column_stack([ahead[:, 1], -ahead[:, 0]]) / np.linalg.norm(ahead, axis=1)[:, None]
    return np.abs(((curve - true[near]) * normals[near]).sum(axis=1))


@pytest.mark.parametrize("seed", range(1, 5))
def test_the_profile_is_as_near_as_the_thesis_says(seed):
    off = off_mm(profile(seed).curve_mm(DENSE))
    assert off.max() < 1.5 * 0.023564  # table 4.3 at 0.125 mm and 0.015 mm
    assert off.mean() < 0.003
    assert profile(seed).noise_mm == pytest.approx(NOISE_MM / np.sqrt(3.0), rel=0.1)


def test_without_noise_little_is_missed():
    assert off_mm(profile(1, 0.0).curve_mm(DENSE)).max() < 0.006


def test_the_curve_is_closed_and_counter_clockwise():
    x, y = profile().curve_mm(DENSE).T
    assert 0.5 * (x @ np.roll(y, -1) - np.roll(x, -1) @ y) > 100.0
    assert np.allclose(profile().curve_mm(np.array([0.0])), profile().curve_mm(np.array([1.0 - 1e-12])))


def test_the_spline_has_the_fewest_segments_and_its_points_are_surer_than_the_scan():
    found = profile()
    assert found.rms_mm < 0.5 * NOISE_MM / np.sqrt(3.0)
    assert len(found.control_mm) < len(found.order) // 2


def test_outliers_do_not_bend_the_profile():
    rng = np.random.default_rng(3)
    points = scan(4).copy()
    stray = rng.choice(len(points), len(points) // 200, replace=False)
    points[stray, :2] += rng.normal(scale=0.15, size=(len(stray), 2))
    curve = reconstruct_thesis(points, Z, NOISE_MM / np.sqrt(3.0)).curve_mm(DENSE)
    off = off_mm(curve)
    assert np.percentile(off, 99) < 0.03
    assert np.linalg.norm(centroid_of(curve) - centroid_of(PART.section(Z))) < 0.015


def test_points_are_taken_into_the_plane_along_the_surface():
    """A cone: what lies higher stands further in, until it is moved down along the wall."""
    rng = np.random.default_rng(5)
    z, angle = rng.uniform(-1.0, 1.0, 40_000), rng.uniform(0.0, 2.0 * np.pi, 40_000)
    radius = 5.0 - 0.4 * z
    cone = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])
    taken = take_into_plane(cone, 0.0, RwllsSettings())
    assert np.abs(np.linalg.norm(taken.points_mm, axis=1) - 5.0).max() < 1e-4
    radial = taken.points_mm / np.linalg.norm(taken.points_mm, axis=1)[:, None]
    assert np.abs((radial * taken.normals).sum(axis=1)).min() > 0.999
    assert ((taken.weights >= 0.0) & (taken.weights <= 1.0)).all()


def test_an_outlier_weighs_less():
    points = scan(6)
    plain = take_into_plane(points, Z, RwllsSettings())
    inside = int(np.argmin(np.abs(points[:, 2] - Z)))
    normal = plain.normals[np.argmin(np.linalg.norm(plain.points_mm - points[inside, :2], axis=1))]
    moved = points.copy()
    moved[inside, :2] += 0.06 * normal
    found = take_into_plane(moved, Z, RwllsSettings())
    at = int(np.argmin(np.linalg.norm(found.points_mm - moved[inside, :2], axis=1)))
    assert found.weights[at] < 0.3 * np.median(found.weights)


def test_sigmas_are_those_of_repeated_scans():
    """The centroid's scatter over scans, against what the noise is propagated to."""
    misses, sigmas = [], []
    for seed in range(10, 34):
        found = profile(seed)
        curve = found.curve_mm(DENSE)
        ahead = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
        share = 0.5 * np.linalg.norm(ahead, axis=1)
        normals = np.column_stack([ahead[:, 1], -ahead[:, 0]]) / np.linalg.norm(ahead, axis=1)[:, None]
        x, y = curve.T
        area = 0.5 * (x @ np.roll(y, -1) - np.roll(x, -1) @ y)
        gradients = ((curve - centroid_of(curve)) * share[:, None] / area).T
        sigmas.append(found.noise_mm * np.sqrt((found.growth(DENSE, normals, gradients) ** 2).sum(axis=0)))
        misses.append(centroid_of(curve) - centroid_of(PART.section(Z)))
    z = np.array(misses) / np.array(sigmas)
    assert 0.6 < np.sqrt((z**2).mean()) < 1.4


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (np.zeros((0, 3)), "fewer than"),
        (np.random.default_rng(0).normal(size=(30, 3)), "fewer than"),
        (
            np.column_stack([np.random.default_rng(1).uniform(0, 30, (4000, 2)) * [1, 0], np.zeros(4000)]),
            "points",
        ),
    ],
)
def test_what_is_no_section_is_refused(points, reason):
    with pytest.raises(CannotMeasure, match=reason):
        reconstruct_thesis(points, 0.0, 0.01)


def test_a_profile_with_a_gap_is_refused():
    points = scan(7)
    with pytest.raises(CannotMeasure, match="profile"):
        reconstruct_thesis(points[np.abs(points[:, 0]) > 1.5], Z, 0.01)


@pytest.mark.parametrize(
    "wrong", [{"slab_spacings": 0.0}, {"upright": 1.5}, {"min_points": 3}, {"growth": -1.0}]
)
def test_settings_that_contradict_themselves_are_refused(wrong):
    with pytest.raises(BadInput, match="sectional points"):
        RwllsSettings(**wrong)


@pytest.mark.parametrize("uncertainty_mm", [0.0, -0.01, np.nan, np.inf])
def test_an_uncertainty_that_is_none_is_refused(uncertainty_mm):
    with pytest.raises(BadInput, match="uncertainty"):
        reconstruct_thesis(scan(1), Z, uncertainty_mm)
