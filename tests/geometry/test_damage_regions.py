"""What is metal of the blade and what only floats beside it."""

from functools import cache

import numpy as np

from geometry.damage.regions import Region, RegionSettings, find_regions, stand_off
from geometry.types import Cloud, Floats, Zone
from tests.geometry import repair_blades as blades
from tests.geometry.test_damage_depth import nominal

NOISE_MM, PER_MM2 = 0.01, 12.0
AT_MM, NORMAL = blades.suction_side_at(0.5, 20.0)


@cache
def sound() -> blades.Specimen:
    return blades.specimen({}, NOISE_MM, np.random.default_rng(0), PER_MM2)


def regions_of(points_mm: Floats) -> list[Region]:
    specimen, count = sound(), len(points_mm)
    cloud = Cloud(
        points_mm=points_mm,
        sigma_mm=np.full(count, NOISE_MM),
        view=np.zeros(count, np.int64),
    )
    settings = RegionSettings()
    field = stand_off(cloud, specimen.alignment, nominal(), specimen.twin, settings)
    return find_regions(field, nominal(), settings)


def beside(extra_mm: Floats) -> list[Region]:
    return regions_of(np.concatenate([sound().cloud.points_mm, extra_mm]))


def plate(off_mm: float, rng: np.random.Generator) -> Floats:
    """A dense square plate over the suction side."""
    first, second, _ = blades.frame_with_z(NORMAL).T
    u, v = rng.uniform(-3.0, 3.0, (2, 600, 1))
    return np.asarray(AT_MM + off_mm * NORMAL + u * first + v * second)


def test_scatter_and_a_plate_beside_the_blade_are_no_damage() -> None:
    rng = np.random.default_rng(1)
    scatter = AT_MM + 15.0 * NORMAL + rng.uniform(-8.0, 8.0, (300, 3))
    assert beside(scatter) == []
    assert beside(plate(3.0, rng)) == []


def test_a_burr_that_grows_out_of_the_skin_is_excess() -> None:
    points = sound().cloud.points_mm.copy()
    away = np.linalg.norm(points - AT_MM, axis=1)
    lift = 1.5 * np.clip(1.0 - (away / 1.5) ** 2, 0.0, None)
    (burr,) = regions_of(points + lift[:, None] * NORMAL)
    assert not burr.missing
    assert np.isin(np.flatnonzero(lift > 0.1), burr.points).mean() > 0.95


def test_a_break_is_found_whole_beside_a_plate() -> None:
    cutters, rng = {Zone.SURFACE: blades.pit_cutter()}, np.random.default_rng(2)
    broken = blades.specimen(cutters, NOISE_MM, rng, PER_MM2)
    (pit,) = regions_of(np.concatenate([broken.cloud.points_mm, plate(3.0, rng)]))
    assert pit.missing
    assert np.isin(np.flatnonzero(broken.on_break >= 0), pit.points).mean() > 0.9
