"""Scans of a part that moved between views: metal that counts as lost under skin that was scanned as well."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from geometry.blade.nominal import Nominal, NominalSettings, prepare_nominal
from geometry.damage.damages import Damage, DamageKind, find_damages
from geometry.repair.patches import RepairSettings, find_repairs
from geometry.types import Measurand, NotMeasured, Zone
from tests.geometry import repair_blades as blades


@cache
def nominal() -> Nominal:
    return prepare_nominal(blades.blade_mesh(), NominalSettings(z_min_mm=1.0))


def damages_of(specimen: blades.Specimen) -> tuple[Damage, ...]:
    none = np.zeros(len(specimen.cloud), bool)
    return find_damages(specimen.cloud, none, specimen.alignment, nominal(), specimen.twin)


def moved(share: float, off_mm: float, seed: int) -> blades.Specimen:
    """A whole blade, of which a share of the points was taken after it had moved aside."""
    rng = np.random.default_rng(seed)
    whole = blades.specimen({}, 0.01, rng, 60.0)
    late = (rng.random(len(whole.cloud)) < share) & (whole.cloud.points_mm[:, 2] > 15.0)
    points_mm = whole.cloud.points_mm + late[:, None] * np.array([0.2, 1.0, 0.0]) * off_mm
    return replace(
        whole,
        cloud=replace(whole.cloud, points_mm=points_mm),
        twin=blades.twin_of(whole.twin.mesh, ~late, 0.01),
    )


@pytest.mark.parametrize("share", [0.25, 0.5])
@pytest.mark.parametrize("off_mm", [0.25, 0.5])
def test_what_a_part_that_moved_seems_to_have_lost_has_no_size(share: float, off_mm: float) -> None:
    missing = [d for d in damages_of(moved(share, off_mm, 3)) if len(d.points) > 1000]
    assert missing
    assert all(damage.layered for damage in missing)
    for damage in missing:
        if damage.kind is DamageKind.MISSING:
            assert isinstance(damage.depth_mm, NotMeasured)
            assert isinstance(damage.volume_mm3, NotMeasured)


@pytest.mark.parametrize("name", blades.CUTTERS)
@pytest.mark.parametrize("noise_mm", [0.004, 0.02])
def test_metal_that_is_gone_has_no_skin_over_it(name: str, noise_mm: float) -> None:
    zone, cutter = blades.CUTTERS[name]
    specimen = blades.specimen({zone: cutter()}, noise_mm, np.random.default_rng(1), 60.0)
    found = damages_of(specimen)
    assert isinstance(found[0].depth_mm, Measurand)
    assert not any(damage.layered for damage in found)


def test_a_side_that_was_seen_twice_has_lost_nothing() -> None:
    whole = blades.specimen({}, 0.01, np.random.default_rng(3), 60.0)
    points_mm = whole.cloud.points_mm
    late = np.random.default_rng(4).random(len(points_mm)) < 0.25
    late &= (np.abs(points_mm[:, 2] - 25.0) < 10.0) & (points_mm[:, 1] > np.median(points_mm[:, 1]))
    cloud = replace(whole.cloud, points_mm=points_mm - late[:, None] * np.array([0.05, 0.25, 0.0]))
    twin = blades.twin_of(whole.twin.mesh, ~late, 0.01)
    found = damages_of(replace(whole, cloud=cloud, twin=twin))
    assert found[0].kind is DamageKind.MISSING
    assert len(found[0].points) > 1000
    assert found[0].layered
    assert isinstance(found[0].depth_mm, NotMeasured)
    assert isinstance(found[0].volume_mm3, NotMeasured)
    repairs = find_repairs(twin, cloud, whole.alignment, found, RepairSettings())
    assert not repairs.patches
    assert "shows the skin" in repairs.failures[0]


def test_points_that_crowd_in_one_place_are_no_broken_surface() -> None:
    whole = blades.specimen({}, 0.004, np.random.default_rng(2), 60.0)
    at_mm, normal = blades.suction_side_at(0.5, 20.0)
    near = np.argsort(np.linalg.norm(whole.cloud.points_mm - at_mm, axis=1))[:14]
    points_mm = whole.cloud.points_mm.copy()
    points_mm[near] = at_mm - 0.5 * normal + np.random.default_rng(3).normal(0.0, 1e-4, (14, 3))
    crowd = np.isin(np.arange(len(points_mm)), near)
    damage = blades.damage_at(Zone.SURFACE, points_mm, crowd, ring_mm=0.01)
    cloud = replace(whole.cloud, points_mm=points_mm)
    found = find_repairs(whole.twin, cloud, whole.alignment, (damage,), RepairSettings())
    assert "crowd in" in found.failures[0]
    assert not found.patches
