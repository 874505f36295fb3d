"""Shallow hollows of known depth beside deep damage: which are found, and which points lie on them."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from geometry.damage.damages import HOLLOW_SPACINGS, Damage, detection_limit, find_damages
from geometry.deformation.twin import TwinSettings, fit_twin
from geometry.types import Bools, Floats, Measurand, Zone
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
    limit = detection_limit(cloud, twin)[Zone.SURFACE]
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
