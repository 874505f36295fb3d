"""A tip face that was taken for damage calls the pose back; what stays open is said."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from geometry.blade.nominal import NominalSettings, prepare_nominal
from geometry.registration.register import register
from geometry.registration.slide import slides_mm
from geometry.transforms import apply, inverse, rigid
from geometry.types import Cloud
from tests.geometry import blades

MILD = blades.Blade(taper=0.02, thickness_taper=0.05)
SIGMA_MM = 0.012


@cache
def nominal():
    return prepare_nominal(blades.mesh(MILD), NominalSettings(z_min_mm=6.0, z_max_mm=MILD.height_mm))


def worn(seed, per_mm2, slope, cut_mm):
    """A scan of a blade whose tip is partly gone, bent and untwisted by service."""
    rng = np.random.default_rng(seed)
    scan = blades.with_tip_cut(blades.scan(MILD, per_mm2, rng), MILD, cut_mm, rng, slope)
    scan = blades.with_form_error(scan, 0.05)
    x, y, z = scan.points_mm.T
    turn = np.deg2rad(0.1) * (z / MILD.height_mm) ** 2
    bent = np.column_stack([x - turn * y, y + turn * x + 0.06 * (z / MILD.height_mm) ** 2, z])
    return blades.with_noise(replace(scan, points_mm=bent), SIGMA_MM, rng)


def cloud_of(points_mm, seed):
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    T = rigid(q * np.sign(np.linalg.det(q)), rng.uniform(-100, 100, 3))
    count = len(points_mm)
    points_mm = apply(inverse(T), points_mm)
    return T, Cloud(points_mm=points_mm, sigma_mm=np.full(count, SIGMA_MM), view=np.zeros(count, np.int64))


def off_mm(alignment, T_true):
    samples_mm = nominal().samples.points_mm
    moved_mm = apply(alignment.T_nominal_scan @ inverse(T_true), samples_mm)
    return np.linalg.norm(moved_mm - samples_mm, axis=1).max()


@pytest.mark.parametrize("seed", range(2))
def test_half_a_tip_face_holds_a_blade_that_is_nearly_a_screw(seed):
    scan = worn(seed, 1.0, 0.5, 12.0)
    T_true, cloud = cloud_of(scan.points_mm, seed)
    alignment = register(cloud, nominal())
    assert off_mm(alignment, T_true) < 0.15  # the form itself bends the tip by a tenth
    assert alignment.weak_directions == ()


@pytest.mark.parametrize("seed", range(2))
def test_without_a_tip_face_the_slide_is_never_confident(seed):
    scan = worn(seed, 0.7, 0.2, 14.0)
    lost = scan.points_mm[:, 2] > 99.0
    T_true, cloud = cloud_of(scan.points_mm[~lost], seed)
    alignment = register(cloud, nominal())
    assert alignment.weak_directions or off_mm(alignment, T_true) < 0.15
    assert len(alignment.weak_directions) == 1
    assert alignment.form_covariance[5, 5] > 0.1**2


def test_a_slide_is_found_by_the_face_it_would_explain():
    rng = np.random.default_rng(3)
    points_mm = blades.scan(MILD, 1.0, rng).points_mm + np.array([0.0, 0.0, 1.2])
    tip = points_mm[:, 2] > 106.0
    upward = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    moves_mm = slides_mm(points_mm[~tip], points_mm[tip], upward, 3.0, 0.1, nominal())
    assert moves_mm[0] == pytest.approx(-1.2, abs=0.1)


def test_no_face_no_slide():
    rng = np.random.default_rng(4)
    points_mm = blades.scan(MILD, 1.0, rng).points_mm
    far_mm = points_mm[:200] + np.array([0.0, 50.0, 0.0])
    upward = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    assert len(slides_mm(points_mm, far_mm, upward, 3.0, 0.1, nominal())) == 0
    assert len(slides_mm(points_mm, far_mm[:3], upward, 3.0, 0.1, nominal())) == 0
