"""Alignments on named datums find the pose that the datum has, whatever the rest of the blade does."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geometry.blade.nominal import NominalSettings, prepare_nominal
from geometry.errors import BadInput, CannotRegister
from geometry.registration.datums import (
    SIX,
    DatumSettings,
    register_root,
    register_sections,
    register_six_point,
    service_motion,
)
from geometry.transforms import apply, exp, inverse, log, rigid
from geometry.types import Cloud
from tests.geometry import blades
from tests.geometry.poses import in_place

BLADE = blades.Blade()
SIGMA_MM = 0.015
PIVOT = np.array([0.0, 0.0, 50.0])
POSE = rigid(Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix(), np.array([30.0, -20.0, 10.0]))
MOTION = exp(np.array([2.0e-3, -1.5e-3, 6.0e-3, 0.05, -0.03, 0.02]), PIVOT)  # of the airfoil, in service


@cache
def nominal(z_min_mm=0.0):
    return prepare_nominal(blades.mesh(BLADE), NominalSettings(z_min_mm=z_min_mm, z_max_mm=BLADE.height_mm))


def seen_from(points_mm):
    count = len(points_mm)
    return Cloud(
        points_mm=apply(inverse(POSE), points_mm),
        sigma_mm=np.full(count, SIGMA_MM),
        view=np.zeros(count, np.int64),
    )


def near(seed=0, size=1.0):
    """An alignment a few tenths of a millimetre off."""
    error = np.random.default_rng(seed).normal(size=6) * [1e-3, 1e-3, 2e-3, 0.1, 0.1, 0.1] * size
    start = in_place(exp(error, PIVOT) @ POSE, PIVOT[2], np.eye(6))
    return replace(start, explained_fraction=0.95)


@cache
def clean_scan():
    return blades.scan(BLADE, 2.0, np.random.default_rng(1))


@cache
def noisy_scan(seed=2):
    return blades.with_noise(clean_scan(), SIGMA_MM, np.random.default_rng(seed))


@cache
def bent_scan():
    """Above z = 30 the metal went with MOTION; what bends between is not seen."""
    points_mm = noisy_scan().points_mm
    upper, lower = points_mm[points_mm[:, 2] > 30.0], points_mm[points_mm[:, 2] < 22.0]
    return np.concatenate([lower, apply(MOTION, upper)])


def displacement_mm(alignment, below_mm=200.0):
    """Largest displacement of the lower surface along its normal, and along the span (held by taper)."""
    samples = nominal().samples
    low = (samples.points_mm[:, 2] < below_mm) & ~samples.tip_face
    points_mm = samples.points_mm[low]
    moved = apply(alignment.T_nominal_scan @ inverse(POSE), points_mm) - points_mm
    return np.abs((moved * samples.normals[low]).sum(axis=1)).max(), np.abs(moved[:, 2]).max()


def surprise(alignment):
    """The pose error in its own uncertainty: chi-squared with six degrees of freedom."""
    error = log(alignment.T_nominal_scan @ inverse(POSE), alignment.pivot_mm)
    covariance = np.linalg.inv(alignment.information) + alignment.form_covariance
    return float(error @ np.linalg.solve(covariance, error))


def six_points():
    """Three on the pressure side, two on the leading edge, one in the tip face."""
    t = np.array([-1.0, -2.2, -1.6, 0.0, 0.0])
    z = np.array([15.0, 15.0, 90.0, 20.0, 85.0])
    top = np.full(2, BLADE.height_mm)
    tip = BLADE.point(np.array([1.4, -1.4]), top).mean(axis=0)
    return np.vstack([BLADE.point(t, z), tip])


@pytest.mark.parametrize(
    "find",
    [
        lambda cloud, start: register_root(cloud, nominal(), start, (0.0, 30.0)),
        lambda cloud, start: register_sections(cloud, nominal(), start, [10.0, 50.0, 100.0]),
        lambda cloud, start: register_six_point(cloud, nominal(), start, six_points()),
    ],
    ids=["root", "sections", "six points"],
)
@pytest.mark.parametrize("seed", range(2))
def test_each_finds_an_exact_pose(find, seed):
    alignment = find(seen_from(clean_scan().points_mm), near(seed))
    along_normal, along_span = displacement_mm(alignment)
    assert along_normal < 0.003
    assert along_span < 0.03
    assert alignment.converged
    assert alignment.weak_directions == ()
    assert alignment.explained_fraction == 0.95


def test_the_root_keeps_the_pose_of_a_blade_whose_airfoil_moved():
    alignment = register_root(seen_from(bent_scan()), nominal(), near(3), (0.0, 20.0))
    assert alignment.method == "root"
    assert displacement_mm(alignment, 20.0)[0] < 0.008
    assert surprise(alignment) < 25.0


def test_root_metal_below_the_airfoil_is_a_datum_too():
    upper = nominal(25.0)
    alignment = register_root(seen_from(bent_scan()), upper, near(3), (0.0, 20.0))
    assert displacement_mm(alignment, 20.0)[0] < 0.008
    assert surprise(alignment) < 25.0


def test_damage_in_the_datum_does_not_pull():
    where = BLADE.point(np.array([1.5]), np.array([10.0]))[0]
    dented = blades.with_dent(noisy_scan(), where, 4.0, 0.8)
    plain, hurt = (
        register_root(seen_from(scan.points_mm), nominal(), near(4), (0.0, 30.0))
        for scan in (noisy_scan(), dented)
    )
    assert hurt.inlier_fraction < plain.inlier_fraction
    assert surprise(hurt) < 25.0
    assert displacement_mm(hurt, 30.0)[0] < 0.008


def test_service_motion_is_what_service_did():
    cloud = seen_from(bent_scan())
    root = register_root(cloud, nominal(), near(5), (0.0, 20.0))
    airfoil = register_root(cloud, nominal(), near(6), (33.0, 105.0))
    found = service_motion(root, airfoil, nominal())
    turns = np.rad2deg(log(MOTION, nominal().pivot_mm)[:3])
    for value, true in zip((found.bend_x_deg, found.bend_y_deg, found.twist_deg), turns, strict=True):
        assert abs(value.value - true) < 4.0 * value.sigma, value.name
        assert value.unit == "deg"
    assert found.twist_deg.sigma < 0.03
    top = BLADE.point(np.array([0.0, np.pi]), np.full(2, BLADE.height_mm)).mean(axis=0)
    shift = apply(MOTION, top[None])[0] - top
    for value, true in zip((found.tip_x_mm, found.tip_y_mm, found.tip_z_mm), shift, strict=True):
        assert abs(value.value - true) < 4.0 * value.sigma + 0.005, value.name


def test_no_motion_is_none():
    found = service_motion(near(7), near(7), nominal())
    assert abs(found.twist_deg.value) < 1e-9
    assert abs(found.tip_z_mm.value) < 1e-9


def test_six_points_are_as_certain_as_they_say():
    errors = []
    for seed in range(12):
        alignment = register_six_point(
            seen_from(noisy_scan(seed).points_mm), nominal(), near(seed, 0.2), six_points()
        )
        assert alignment.method == "six_point"
        errors.append(surprise(alignment))
    assert 2.5 < np.mean(errors) < 12.0


@pytest.mark.parametrize("hurt", [0, 3])
def test_a_datum_point_on_damage_is_refused_by_name(hurt):
    dented = blades.with_dent(noisy_scan(), six_points()[hurt], 4.0, 0.8)
    with pytest.raises(CannotRegister, match=f"{SIX[hurt]} lies on damage"):
        register_six_point(seen_from(dented.points_mm), nominal(), near(0, 0.1), six_points())


def test_a_datum_point_without_scan_points_is_refused_by_name():
    points_mm = noisy_scan().points_mm
    bare = np.linalg.norm(points_mm - six_points()[1], axis=1) > 3.0
    with pytest.raises(CannotRegister, match=f"{SIX[1]} has 0 scan points"):
        register_six_point(seen_from(points_mm[bare]), nominal(), near(0, 0.1), six_points())


def test_a_datum_point_off_the_nominal_is_refused_by_name():
    points = six_points()
    points[4] += [3.0, 3.0, 0.0]
    with pytest.raises(CannotRegister, match=f"{SIX[4]} lies off the nominal"):
        register_six_point(seen_from(noisy_scan().points_mm), nominal(), near(), points)


def test_six_points_that_hold_no_pose_are_refused():
    points = BLADE.point(np.full(6, 1.5), np.linspace(10.0, 90.0, 6))
    with pytest.raises(CannotRegister, match="motion free"):
        register_six_point(seen_from(noisy_scan().points_mm), nominal(), near(), points)


@pytest.mark.parametrize("z_mm", [(-30.0, -10.0), (104.9999, 104.99999)])
def test_a_datum_zone_without_points_is_refused(z_mm):
    with pytest.raises(CannotRegister, match="datum z"):
        register_root(seen_from(noisy_scan().points_mm), nominal(), near(0, 0.1), z_mm)


def test_a_section_that_is_gone_is_refused():
    points_mm = noisy_scan().points_mm
    cut = points_mm[points_mm[:, 2] < 90.0]
    with pytest.raises(CannotRegister, match="datum z 97 to 99 mm"):
        register_sections(seen_from(cut), nominal(), near(0, 0.1), [7.0, 52.5, 98.0])


@pytest.mark.parametrize("z_mm", [(20.0, 0.0), (np.nan, 5.0), (5.0, np.inf)])
def test_heights_that_are_no_zone_are_refused(z_mm):
    with pytest.raises(BadInput, match="datum heights"):
        register_root(seen_from(noisy_scan().points_mm), nominal(), near(), z_mm)


def test_no_sections_are_refused():
    with pytest.raises(BadInput, match="datum heights"):
        register_sections(seen_from(noisy_scan().points_mm), nominal(), near(), [])


@pytest.mark.parametrize("points", [np.zeros((5, 3)), np.full((6, 3), np.nan)])
def test_coordinates_that_are_not_six_points_are_refused(points):
    with pytest.raises(BadInput, match="six-point"):
        register_six_point(seen_from(noisy_scan().points_mm), nominal(), near(), points)


@pytest.mark.parametrize("wrong", [{"radius_mm": 0.0}, {"least_points": 2}, {"most_condition": 0.5}])
def test_settings_that_contradict_themselves_are_refused(wrong):
    with pytest.raises(BadInput, match="datums"):
        replace(DatumSettings(), **wrong)
