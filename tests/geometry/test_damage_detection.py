"""Shallow hollows of known depth beside deep damage: which are found, and which points lie on them."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial import cKDTree

from geometry.damage.damages import Damage, find_damages
from geometry.damage.detection import HOLLOW_SPACINGS, detection_limit, kept
from geometry.damage.regions import RegionSettings
from geometry.deformation.twin import TwinSettings, fit_twin
from geometry.types import Bools, Cloud, Floats, Measurand, Measured, NotMeasured, Zone
from tests.geometry import twin_blades as blades
from tests.geometry.airfoils import cloud_of
from tests.geometry.poses import in_place
from tests.geometry.test_twin import nominal

NOISE_MM, PITCH_MM = 0.01, 0.4


@dataclass(frozen=True)
class Case:
    damages: tuple[Damage, ...]
    centres: Floats  # of the hollows
    told: Bools  # (points,) in any damage
    depth_mm: Floats  # (points,) below the undamaged surface, without noise
    limit: Measurand


def centres_of(shape: blades.Shape, rng: np.random.Generator) -> Floats:
    z, theta = np.meshgrid([20.0, 45.0, 70.0], np.pi * np.array([0.3, 0.65, 1.35, 1.7]))
    theta = theta + rng.uniform(-0.1, 0.1, theta.shape)
    return shape.surface(theta, z + rng.uniform(-4.0, 4.0, z.shape)).reshape(-1, 3)


@cache
def scanned(depth_mm: float, width_mm: float, seed: int) -> Case:
    whole = blades.SHAPES["service"]
    centres = centres_of(whole, np.random.default_rng(seed))
    truth = blades.Truth(whole)
    cuts = (blades.tip_corner(),)
    hollowed = blades.hollowed(whole, centres, depth_mm, width_mm)
    scan = blades.scan(truth, cuts, pitch_mm=PITCH_MM, noise_mm=NOISE_MM, scanned=hollowed, seed=seed)
    cloud = cloud_of(scan.points, NOISE_MM)
    twin = fit_twin(cloud, scan.label > 0, in_place(), nominal(), TwinSettings())
    damages = find_damages(cloud, scan.label > 0, in_place(), nominal(), twin)
    told = np.zeros(len(cloud), np.bool_)
    for damage in damages:
        told[damage.points] = True
    deep = blades.hollow_depth(scan.points, centres, depth_mm, width_mm)
    broken = scan.points[scan.label > 0]
    deep[scan.label > 0] = np.minimum(-truth.distance(broken), blades.SPAN_MM - broken[:, 2])
    limit = detection_limit(cloud, in_place(), nominal(), twin).depth_mm[Zone.SURFACE]
    assert isinstance(limit, Measurand)
    return Case(damages, centres, told, deep, limit)


def share_found(case: Case, width_mm: float) -> float:
    middles = np.array([damage.centroid_mm for damage in case.damages])
    apart = np.linalg.norm(case.centres[:, None] - middles, axis=2).min(axis=1)
    return float((apart < 0.5 * width_mm).mean())


def test_hollows_of_a_tenth_of_a_millimetre_are_found_and_nothing_else() -> None:
    case = scanned(0.1, 5.0, 3)
    assert share_found(case, 5.0) == 1.0
    assert len(case.damages) == len(case.centres) + 1


def test_points_on_damage_are_told_from_sound_ones() -> None:
    case = scanned(0.1, 5.0, 3)
    assert case.told[case.depth_mm > 3.0 * NOISE_MM].mean() >= 0.995
    assert case.told[case.depth_mm < 1e-6].mean() <= 0.005


def test_hollows_as_deep_as_the_detection_limit_are_found() -> None:
    width_mm = HOLLOW_SPACINGS * PITCH_MM
    limit_mm = scanned(0.1, 5.0, 3).limit.value
    case = scanned(round(limit_mm, 3), width_mm, 4)
    assert share_found(case, width_mm) >= 0.95


def test_the_depth_of_a_hollow_is_within_its_uncertainty() -> None:
    case = scanned(0.1, 5.0, 3)
    depths = [damage.depth_mm for damage in case.damages if damage.zone is Zone.SURFACE]
    errors = np.array([(d.value - 0.1) / d.sigma for d in depths if isinstance(d, Measurand)])
    assert len(errors) == len(case.centres)
    assert np.abs(errors).max() < 3.0


THIN_MM, HOLLOW_MM = 10.0, 4.0


@cache
def thinly_scanned(spacing_mm: float) -> tuple[Cloud, Floats]:
    """A hollow 0.5 deep on a side, whose points within `THIN_MM` lie no nearer to each other than so."""
    whole = blades.SHAPES["service"]
    centre = whole.surface(np.array([0.65 * np.pi]), np.array([45.0])).reshape(1, 3)
    hollowed = blades.hollowed(whole, centre, 0.5, HOLLOW_MM)
    scan = blades.scan(
        blades.Truth(whole), (), pitch_mm=PITCH_MM, noise_mm=NOISE_MM, scanned=hollowed, seed=5
    )
    near = np.flatnonzero(np.linalg.norm(scan.points - centre, axis=1) < THIN_MM)
    tree = cKDTree(scan.points[near])
    kept_points = np.ones(len(near), np.bool_)
    for i in np.random.default_rng(5).permutation(len(near)):
        if kept_points[i]:
            others = [j for j in tree.query_ball_point(scan.points[near[i]], spacing_mm) if j != i]
            kept_points[others] = False
    return cloud_of(np.delete(scan.points, near[~kept_points], axis=0), NOISE_MM), centre


def found_thinly(spacing_mm: float) -> tuple[tuple[Damage, ...], Floats, Mapping[Zone, Measured]]:
    cloud, centre = thinly_scanned(spacing_mm)
    nothing = np.zeros(len(cloud), np.bool_)
    twin = fit_twin(cloud, nothing, in_place(), nominal(), TwinSettings())
    limits = detection_limit(cloud, in_place(), nominal(), twin).depth_mm
    return find_damages(cloud, nothing, in_place(), nominal(), twin), centre, limits


def test_a_hollow_is_found_where_the_scan_is_thin() -> None:
    damages, centre, _ = found_thinly(0.9)
    assert len(damages) == 1
    assert np.linalg.norm(damages[0].centroid_mm - centre) < 0.5 * HOLLOW_MM
    assert len(damages[0].points) < RegionSettings().least_points


def test_the_limit_of_a_side_is_that_of_its_thinnest_place() -> None:
    whole, thin, none = (found_thinly(spacing)[2] for spacing in (0.0, 0.7, 1.3))
    dense, sparse, lacking = (limits[Zone.SURFACE] for limits in (whole, thin, none))
    assert isinstance(dense, Measurand)
    assert isinstance(sparse, Measurand)
    assert sparse.value > 1.3 * dense.value
    assert isinstance(lacking, NotMeasured)
    assert "apart in places" in lacking.reason


def test_the_area_is_that_of_the_hollow_that_the_depth_is_stated_for() -> None:
    cloud, _ = thinly_scanned(0.7)
    twin = fit_twin(cloud, np.zeros(len(cloud), np.bool_), in_place(), nominal(), TwinSettings())
    area = detection_limit(cloud, in_place(), nominal(), twin).area_mm2
    assert isinstance(area, Measurand)
    assert abs(area.value - 0.25 * np.pi * (HOLLOW_SPACINGS * PITCH_MM) ** 2) < 0.15 * area.value


def test_few_points_apart_from_a_dense_surface_are_no_region() -> None:
    cloud, _centre = thinly_scanned(0.0)
    sides = blades.SHAPES["service"].surface(np.pi * np.array([0.65, 1.35]), np.full(2, 75.0)).reshape(2, 3)
    inside = sides.mean(axis=0) + np.random.default_rng(0).uniform(-0.1, 0.1, (6, 3))
    twin = fit_twin(cloud, np.zeros(len(cloud), np.bool_), in_place(), nominal(), TwinSettings())
    more = cloud_of(np.concatenate([cloud.points_mm, inside]), NOISE_MM)
    damages = find_damages(more, np.zeros(len(more), np.bool_), in_place(), nominal(), twin)
    assert len(damages) == 1
    assert damages[0].points.max() < len(cloud)


def test_what_a_hollow_keeps_of_its_depth_is_its_mean_over_a_disc() -> None:
    for share in (0.3, 0.9, 1.0, 1.7):
        r = np.linspace(0.0, share, 20_001)
        depth = np.where(r < 1.0, 0.5 + 0.5 * np.cos(np.pi * np.minimum(r, 1.0)), 0.0)
        assert abs(kept(share) - np.trapezoid(depth * 2.0 * r, r) / share**2) < 1e-4
