"""Damage regions of a blade whose broken corner and pit are known exactly, against its fitted twin."""

from functools import cache

import numpy as np

from geometry.damage.damages import Damage, DamageKind, find_damages
from geometry.damage.detection import detection_limit
from geometry.deformation.twin import TwinSettings, fit_twin
from geometry.types import Bools, Measurand, Zone
from tests.geometry import twin_blades as blades
from tests.geometry.airfoils import cloud_of
from tests.geometry.poses import in_place
from tests.geometry.test_twin import nominal

NOISE_MM = 0.01


@cache
def found() -> tuple[tuple[Damage, ...], Bools, dict[Zone, object]]:
    """The damages of a scan, which of its points truly lie on damage, and the detection limits."""
    truth = blades.Truth(blades.SHAPES["service"])
    cuts = (blades.tip_corner(), blades.pit(truth, 1.5 * np.pi, 48.0, 1.5, 3.2))
    scan = blades.scan(truth, cuts, pitch_mm=0.4, noise_mm=NOISE_MM)
    cloud, mask = cloud_of(scan.points, NOISE_MM), scan.label > 0
    twin = fit_twin(cloud, mask, in_place(), nominal(), TwinSettings())
    damages = find_damages(cloud, mask, in_place(), nominal(), twin)
    return damages, mask, detection_limit(cloud, in_place(), nominal(), twin).depth_mm


def test_the_broken_corner_and_the_pit_are_found_in_their_zones_and_nothing_else() -> None:
    damages, _, _ = found()
    assert sorted(damage.zone for damage in damages) == [Zone.SURFACE, Zone.TIP]
    assert {damage.kind for damage in damages} == {DamageKind.MISSING}


def test_the_points_on_damage_are_found_and_sound_ones_left() -> None:
    damages, true, _ = found()
    told = np.zeros(len(true), np.bool_)
    for damage in damages:
        told[damage.points] = True
    assert told[true].mean() > 0.9
    assert told[~true].mean() < 0.01


def test_the_pit_is_as_deep_as_it_was_cut() -> None:
    damages, _, _ = found()
    (pit,) = (damage for damage in damages if damage.zone is Zone.SURFACE)
    assert isinstance(pit.depth_mm, Measurand)
    assert abs(pit.depth_mm.value - 1.5) < max(0.1, 3.0 * pit.depth_mm.sigma)


def test_a_detection_limit_stands_for_every_zone_and_lies_above_the_noise() -> None:
    _, _, limits = found()
    for zone in (Zone.TIP, Zone.LEADING_EDGE, Zone.TRAILING_EDGE, Zone.SURFACE):
        limit = limits[zone]
        assert isinstance(limit, Measurand)
        assert NOISE_MM < limit.value < 1.0
