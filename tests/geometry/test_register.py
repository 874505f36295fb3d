"""Registration finds the pose that was put in, and says when it could not."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geometry.blade.nominal import NominalSettings, prepare_nominal
from geometry.errors import BadInput, CannotRegister
from geometry.registration.coarse import CoarseSettings
from geometry.registration.fit import Fit, fit_kept, information
from geometry.registration.register import RegisterSettings, mask_damage, register
from geometry.transforms import apply, check_rigid, inverse, log, rigid
from geometry.types import Cloud
from tests.geometry import blades

BLADE = blades.Blade()
SCREW = blades.Blade(taper=0.0, thickness_taper=0.0)
SIGMA_MM = 0.015


@cache
def nominal(blade=BLADE):
    return prepare_nominal(blades.mesh(blade), NominalSettings(z_min_mm=0.0, z_max_mm=blade.height_mm))


def pose(seed):
    rng = np.random.default_rng(seed)
    return rigid(Rotation.random(random_state=seed).as_matrix(), rng.uniform(-100, 100, 3))


def seen_from(scan, T_nominal_scan):
    points_mm = apply(inverse(T_nominal_scan), scan.points_mm)
    count = len(points_mm)
    return Cloud(points_mm=points_mm, sigma_mm=np.full(count, SIGMA_MM), view=np.zeros(count, np.int64))


def damaged_scan(rng, per_mm2=2.0):
    scan = blades.scan(BLADE, per_mm2, rng)
    dented = blades.with_dent(scan, BLADE.point(np.array([4.5]), np.array([50.0]))[0], 4.0, 1.0)
    return blades.with_tip_cut(dented, BLADE, 10.0, rng)


def displacement_mm(T_found, T_true, blade=BLADE):
    """Largest displacement of the surface, and largest along the normal of its sides."""
    samples = nominal(blade).samples
    moved = apply(T_found @ inverse(T_true), samples.points_mm) - samples.points_mm
    along = np.einsum("nj,nj->n", moved, samples.normals)
    return np.linalg.norm(moved, axis=1).max(), np.abs(along[~samples.tip_face]).max()


def oracle_mm(scan, T_true, alignment):
    """Displacement between the found pose and the least-squares pose of the points known to be sound."""
    cloud = seen_from(scan, T_true)
    found = nominal().closest(apply(T_true, cloud.points_mm))
    start = Fit(T_nominal_scan=T_true, found=found, weak=(), iterations=0, converged=False)
    known = fit_kept(cloud.points_mm, start, scan.depth_mm == 0.0, nominal(), steps=20, close_mm=1e-7)
    return displacement_mm(alignment.T_nominal_scan, known.T_nominal_scan)[0]


@pytest.mark.parametrize("seed", range(6))
def test_a_damaged_scan_comes_home_from_any_pose(seed):
    rng = np.random.default_rng(seed)
    scan = blades.with_noise(damaged_scan(rng), SIGMA_MM, rng)
    alignment = register(seen_from(scan, pose(seed)), nominal())
    check_rigid(alignment.T_nominal_scan, "alignment")
    assert displacement_mm(alignment.T_nominal_scan, pose(seed))[0] < 0.006
    assert oracle_mm(scan, pose(seed), alignment) < 0.002
    assert alignment.converged
    assert alignment.runner_up_ratio > 5.0
    assert alignment.weak_directions == ()
    assert alignment.noise_mm == pytest.approx(SIGMA_MM, rel=0.05)
    assert alignment.explained_fraction > 0.97


def test_without_noise_the_fit_agrees_with_the_one_that_knows_the_damage():
    scan = blades.with_form_error(damaged_scan(np.random.default_rng(10)), 0.02)
    alignment = register(seen_from(scan, pose(10)), nominal())
    assert oracle_mm(scan, pose(10), alignment) < 0.002


@pytest.mark.parametrize("seed", range(4))
def test_a_scan_without_its_top_quarter_still_finds_its_place(seed):
    rng = np.random.default_rng(seed)
    scan = damaged_scan(rng, per_mm2=1.0)
    ragged = scan.points_mm[:, 2] < 78.0 + 1.5 * np.sin(scan.points_mm[:, 0])
    partial = replace(
        scan, points_mm=scan.points_mm[ragged], normals=scan.normals[ragged], depth_mm=scan.depth_mm[ragged]
    )
    alignment = register(seen_from(blades.with_noise(partial, 0.02, rng), pose(seed)), nominal())
    largest, along_normal = displacement_mm(alignment.T_nominal_scan, pose(seed))
    assert largest < 0.5  # along the screw only the taper holds it
    assert along_normal < 0.01


def test_metal_of_a_fixture_does_not_pull():
    rng = np.random.default_rng(20)
    scan = blades.with_noise(damaged_scan(rng), SIGMA_MM, rng)
    block = rng.uniform([-30, -25, -30], [30, 25, -1], (len(scan.points_mm) // 2, 3))
    alone = seen_from(scan, pose(20))
    points_mm = np.concatenate([alone.points_mm, apply(inverse(pose(20)), block)])
    count = len(points_mm)
    both = Cloud(points_mm=points_mm, sigma_mm=np.full(count, SIGMA_MM), view=np.zeros(count, np.int64))
    alignment = register(both, nominal())
    assert displacement_mm(alignment.T_nominal_scan, pose(20))[0] < 0.006
    assert alignment.explained_fraction > 0.97


@pytest.mark.parametrize("seed", [1, 3])
def test_a_fixture_level_with_the_end_of_the_blade_does_not_pull(seed):
    rng = np.random.default_rng(seed)
    scan = blades.with_noise(blades.with_form_error(blades.scan(BLADE, 0.6, rng), 0.03), SIGMA_MM, rng)
    count = len(scan.points_mm) // 2
    level_mm = np.column_stack([rng.uniform([-30, -20], [30, 20], (count, 2)), np.zeros(count)])
    level_mm += rng.normal(scale=SIGMA_MM, size=level_mm.shape)
    both = replace(scan, points_mm=np.concatenate([scan.points_mm, level_mm]))
    alignment = register(seen_from(both, pose(seed)), nominal())
    assert alignment.converged
    assert displacement_mm(alignment.T_nominal_scan, pose(seed))[0] < 0.02


def test_the_mask_finds_deep_damage_and_spares_the_rest():
    rng = np.random.default_rng(30)
    scan = blades.with_noise(damaged_scan(rng), SIGMA_MM, rng)
    cloud = seen_from(scan, pose(30))
    flags = mask_damage(cloud, register(cloud, nominal()), nominal())
    assert flags[scan.depth_mm > 3.0 * SIGMA_MM].mean() > 0.99
    assert flags[scan.depth_mm == 0.0].mean() < 0.03


def test_information_is_the_inverse_of_the_scatter_of_the_pose():
    rng = np.random.default_rng(1)
    exact = nominal().closest(blades.scan(BLADE, 0.5, rng).points_mm)
    squares = []
    for _ in range(200):
        noise_mm = rng.normal(scale=SIGMA_MM, size=len(exact.points_mm))
        points_mm = exact.points_mm + noise_mm[:, None] * exact.normals
        start = Fit(
            T_nominal_scan=np.eye(4),
            found=nominal().closest(points_mm),
            weak=(),
            iterations=0,
            converged=False,
        )
        fit = fit_kept(points_mm, start, np.ones(len(points_mm), bool), nominal())
        sigma_mm = np.full(len(points_mm), SIGMA_MM)
        known = information(nominal(), points_mm, fit.found.normals, sigma_mm)
        error = log(fit.T_nominal_scan, nominal().pivot_mm)
        squares.append(error @ known @ error)
    assert np.mean(squares) == pytest.approx(6.0, rel=0.15)


def test_a_screw_without_ends_is_reported_as_weak():
    rng = np.random.default_rng(40)
    scan = blades.with_noise(blades.scan(SCREW, 1.0, rng, tip_face=False), SIGMA_MM, rng)
    middle = (scan.points_mm[:, 2] > 10.0) & (scan.points_mm[:, 2] < 90.0)
    scan = replace(scan, points_mm=scan.points_mm[middle], normals=scan.normals[middle])
    alignment = register(seen_from(scan, pose(40)), nominal(SCREW))
    assert len(alignment.weak_directions) == 1
    twist = np.array(alignment.weak_directions[0])
    lead = twist[5] / twist[2]
    assert abs(lead) == pytest.approx(105.0 / np.deg2rad(25.0), rel=0.1)
    assert displacement_mm(alignment.T_nominal_scan, pose(40), SCREW)[1] < 0.02


def test_a_screw_with_its_tip_face_is_held():
    rng = np.random.default_rng(41)
    scan = blades.with_noise(blades.scan(SCREW, 1.0, rng), SIGMA_MM, rng)
    alignment = register(seen_from(scan, pose(41)), nominal(SCREW))
    assert alignment.weak_directions == ()
    assert displacement_mm(alignment.T_nominal_scan, pose(41), SCREW)[0] < 0.01


def test_a_wrong_part_is_not_explained():
    rng = np.random.default_rng(50)
    other = blades.Blade(chord_mm=38.0, thickness_mm=6.5, camber=0.12, twist_deg=40.0)
    try:
        explained = register(seen_from(blades.scan(other, 1.0, rng), pose(50)), nominal()).explained_fraction
    except CannotRegister:
        explained = 0.0  # refused outright, which is a HOLD too
    assert explained < 0.5


def test_the_same_points_in_another_order_give_the_same_pose():
    rng = np.random.default_rng(60)
    cloud = seen_from(blades.with_noise(damaged_scan(rng), SIGMA_MM, rng), pose(60))
    order = rng.permutation(len(cloud))
    shuffled = Cloud(points_mm=cloud.points_mm[order], sigma_mm=cloud.sigma_mm, view=cloud.view)
    a, b = (register(c, nominal()).T_nominal_scan for c in (cloud, shuffled))
    assert displacement_mm(a, b)[0] < 0.0005


def _line(rng):
    return rng.uniform(0, 100, (500, 1)) * [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (lambda rng: np.zeros((0, 3)), "0 scan points"),
        (lambda rng: rng.normal(size=(3, 3)), "3 scan points"),
        (lambda rng: np.tile([1.0, 2.0, 3.0], (500, 1)), "on a line"),
        (_line, "on a line"),
    ],
)
def test_too_little_to_register_is_said(points, reason):
    points_mm = points(np.random.default_rng(70))
    count = len(points_mm)
    cloud = Cloud(points_mm=points_mm, sigma_mm=np.full(count, SIGMA_MM), view=np.zeros(count, np.int64))
    with pytest.raises(CannotRegister, match=reason):
        register(cloud, nominal())


def test_random_points_are_never_an_accepted_part():
    rng = np.random.default_rng(80)
    points_mm = rng.uniform(-50, 50, (3000, 3))
    cloud = Cloud(points_mm=points_mm, sigma_mm=np.full(3000, SIGMA_MM), view=np.zeros(3000, np.int64))
    try:
        alignment = register(cloud, nominal())
    except CannotRegister:
        return
    assert alignment.explained_fraction < 0.1


@pytest.mark.parametrize(
    "wrong", [{"least_points": 3}, {"rounds": 0}, {"explained_mm": 0.0}, {"robust_points": 10}]
)
def test_settings_that_contradict_themselves_are_refused(wrong):
    with pytest.raises(BadInput, match="register"):
        RegisterSettings(**wrong)


def test_coarse_settings_that_contradict_themselves_are_refused():
    with pytest.raises(BadInput, match="coarse"):
        CoarseSettings(cap_mm=0.0)


@pytest.mark.parametrize("factor", [1e-3, 1.0 / 25.4, 25.4])
def test_a_scan_in_another_unit_is_said_to_be_one(factor):
    scan = blades.scan(BLADE, 0.5, np.random.default_rng(0))
    cloud = seen_from(scan, pose(3))
    with pytest.raises(CannotRegister, match="another unit"):
        register(replace(cloud, points_mm=factor * cloud.points_mm), nominal())


def test_the_pose_fits_the_surface_and_not_the_points():
    """Bow of 0.2, a quarter of the part seen a fourth as densely: by points, the pose would be 0.28 off. What
    the mask takes of a bow differs from draw to draw: eight of them lay 0.006 to 0.075 apart."""
    rng = np.random.default_rng(3)
    scan = blades.scan(BLADE, 8.0, rng)
    normals = nominal().closest(scan.points_mm).normals
    bow_mm = 0.2 * np.cos(2.0 * np.pi * scan.points_mm[:, 2] / BLADE.height_mm)
    points_mm = scan.points_mm + np.column_stack([np.zeros(len(bow_mm)), bow_mm, np.zeros(len(bow_mm))])
    sparse = (
        (points_mm[:, 2] > 0.5 * BLADE.height_mm) & (normals[:, 1] > 0.0) & (rng.random(len(bow_mm)) < 0.75)
    )
    poses = []
    for chosen_mm in (points_mm[rng.random(len(bow_mm)) < 0.5], points_mm[~sparse]):
        count = len(chosen_mm)
        cloud = Cloud(points_mm=chosen_mm, sigma_mm=np.full(count, SIGMA_MM), view=np.zeros(count, np.int64))
        poses.append(register(cloud, nominal()).T_nominal_scan)
    assert displacement_mm(*poses)[1] < 0.1
