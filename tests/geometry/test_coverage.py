"""Coverage of the required surface: what is seen, absent or unseen on a blade of known damage."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from geometry.blade.nominal import Nominal, NominalSettings, prepare_nominal
from geometry.coverage import CoverageSettings, CoverageStatus, ZoneCoverage, measure_coverage
from geometry.damage.damages import Damage, DamageKind, DamageSettings, find_damages
from geometry.damage.skin import Skin
from geometry.errors import BadInput
from geometry.repair.patches import RepairSettings, RepairVolume, find_repairs
from geometry.types import Bools, Mesh, Zone
from tests.geometry import repair_blades as blades

PITCH_MM = 0.5
Z_MIN_MM = 20.0


@cache
def nominal() -> Nominal:
    """The upper half of the blade is required: the lower one is hidden by the fixture."""
    return prepare_nominal(blades.blade_mesh(PITCH_MM), NominalSettings(z_min_mm=Z_MIN_MM))


@cache
def sound() -> blades.Specimen:
    return blades.specimen({}, 0.015, np.random.default_rng(0), pitch_mm=PITCH_MM, z_from_mm=Z_MIN_MM - 1.0)


@cache
def broken_tip() -> tuple[blades.Specimen, RepairVolume]:
    cutter = {Zone.TIP: blades.tip_corner_cutter()}
    specimen = blades.specimen(cutter, 0.015, np.random.default_rng(1), pitch_mm=PITCH_MM, z_from_mm=19.0)
    return specimen, repairs_of(specimen)


def repairs_of(specimen: blades.Specimen) -> RepairVolume:
    return find_repairs(specimen.twin, specimen.cloud, specimen.alignment, specimen.damages, RepairSettings())


def coverage_of(
    specimen: blades.Specimen, repairs: RepairVolume | None = None, damages: tuple[Damage, ...] = ()
) -> dict[Zone, ZoneCoverage]:
    rows = measure_coverage(
        specimen.cloud, specimen.alignment, nominal(), specimen.twin, repairs, CoverageSettings(), damages
    )
    return {row.zone: row for row in rows}


def seen(rows: dict[Zone, ZoneCoverage]) -> set[Zone]:
    return {zone for zone, row in rows.items() if row.status is CoverageStatus.SEEN}


def near(specimen: blades.Specimen, at_mm: blades.Array, radius_mm: float) -> Bools:
    return np.asarray(np.linalg.norm(specimen.cloud.points_mm - at_mm, axis=1) < radius_mm)


def test_a_full_scan_sees_every_zone_though_the_root_is_hidden() -> None:
    rows = coverage_of(sound())
    assert seen(rows) == {Zone.TIP, Zone.LEADING_EDGE, Zone.TRAILING_EDGE, Zone.SURFACE}
    for row in rows.values():
        assert row.covered_fraction == pytest.approx(1.0)
        assert row.absent_fraction == 0.0
        assert 0.3 < row.largest_gap_mm < 1.2


@pytest.mark.parametrize("seed", range(6))
def test_a_hole_anywhere_is_found_with_its_size(seed: int) -> None:
    rng = np.random.default_rng(seed)
    samples = nominal().samples
    index = int(rng.integers(len(samples.points_mm)))
    zone = tuple(Zone)[samples.zone[index]]
    radius_mm = float(rng.uniform(0.9, 2.5))
    specimen = blades.without(sound(), near(sound(), samples.points_mm[index], radius_mm))
    row = coverage_of(specimen)[zone]
    assert row.status is CoverageStatus.UNSEEN
    assert row.largest_gap_mm >= 2.0 * radius_mm - 0.25
    assert row.largest_gap_mm <= 2.0 * radius_mm + 1.0


def test_a_hole_within_the_rule_is_not_a_gap() -> None:
    at, _ = blades.suction_side_at(0.5, 30.0)
    rows = coverage_of(blades.without(sound(), near(sound(), at, 0.55)))
    assert Zone.SURFACE in seen(rows)
    assert 1.1 - 0.1 <= rows[Zone.SURFACE].largest_gap_mm <= 1.5


def test_the_other_side_of_a_thin_edge_does_not_stand_in() -> None:
    specimen = sound()
    edge_mm = blades.trailing_edge_at(30.0)
    _, outward = blades.pressure_side_at(0.97, 30.0)
    points = specimen.cloud.points_mm
    pressure = near(specimen, edge_mm, 3.0) & ((points - edge_mm) @ outward > -0.25)
    assert pressure.sum() > 50
    rest = near(specimen, edge_mm, 3.0).sum() - pressure.sum()
    assert rest > 50  # the suction side, half a millimetre away, is still there
    rows = coverage_of(blades.without(specimen, pressure))
    assert rows[Zone.TRAILING_EDGE].status is CoverageStatus.UNSEEN
    assert rows[Zone.TRAILING_EDGE].largest_gap_mm > 1.8


def test_an_edge_that_wore_back_is_seen_where_it_went() -> None:
    """Of an edge 0.8 mm back every point has its foot on the nominal's sides, none on its end."""
    specimen = sound()
    mesh, points_mm = specimen.twin.mesh, specimen.cloud.points_mm
    worn_mm = worn_back(mesh.vertices_mm, 0.8)
    twin = replace(
        specimen.twin,
        mesh=replace(mesh, vertices_mm=worn_mm),
        displacement_mm=specimen.twin.displacement_mm + worn_mm - mesh.vertices_mm,
    )
    cloud = replace(specimen.cloud, points_mm=worn_back(points_mm, 0.8))
    rows = coverage_of(replace(specimen, twin=twin, cloud=cloud))
    assert len(seen(rows)) == 4
    assert rows[Zone.TRAILING_EDGE].largest_gap_mm < 1.2


def worn_back(points_mm: blades.Array, back_mm: float) -> blades.Array:
    """Points (n, 3) within 3 mm of the trailing edge moved towards the leading one, the nearest most."""
    edge_mm = np.array([blades.trailing_edge_at(z_mm) for z_mm in np.linspace(0.0, blades.SPAN_MM, 121)])
    lead_mm = np.array([blades.leading_edge_at(z_mm) for z_mm in np.linspace(0.0, blades.SPAN_MM, 121)])
    index = np.clip(np.rint(points_mm[:, 2] / blades.SPAN_MM * 120.0), 0, 120).astype(int)
    back = lead_mm[index] - edge_mm[index]
    back /= np.linalg.norm(back, axis=1)[:, None]
    near_mm = ((points_mm - edge_mm[index]) * back)[:, :2].sum(axis=1)
    return np.asarray(points_mm + back_mm * np.clip(1.0 - near_mm / 3.0, 0.0, 1.0)[:, None] * back)


def test_a_tip_face_that_was_not_scanned_is_missed() -> None:
    specimen = sound()
    face = specimen.cloud.points_mm[:, 2] > blades.SPAN_MM - 0.08
    rows = coverage_of(blades.without(specimen, face))
    assert rows[Zone.TIP].status is CoverageStatus.UNSEEN
    assert rows[Zone.TIP].largest_gap_mm > 1.5
    assert seen(rows) == {Zone.LEADING_EDGE, Zone.TRAILING_EDGE, Zone.SURFACE}


def test_a_side_never_seen_has_a_finite_gap_as_large_as_the_part() -> None:
    specimen = sound()
    skin = Skin(specimen.twin.mesh)
    _, outward = blades.pressure_side_at(0.5, 30.0)
    away = skin.normals[skin.closest(specimen.cloud.points_mm)[2]] @ outward > 0.0
    rows = coverage_of(blades.without(specimen, away))
    assert rows[Zone.SURFACE].status is CoverageStatus.UNSEEN
    assert 10.0 < rows[Zone.SURFACE].largest_gap_mm < 100.0
    assert rows[Zone.SURFACE].covered_fraction < 0.7


def test_metal_that_is_absent_counts_once_its_break_was_seen() -> None:
    specimen, repairs = broken_tip()
    assert not repairs.failures
    rows = coverage_of(specimen, repairs)
    assert len(seen(rows)) == 4
    assert 0.1 < rows[Zone.TIP].absent_fraction < 0.6
    assert rows[Zone.LEADING_EDGE].absent_fraction == 0.0
    without_patch = coverage_of(specimen)
    assert without_patch[Zone.TIP].status is CoverageStatus.UNSEEN
    assert without_patch[Zone.TIP].largest_gap_mm > 3.0


def test_a_hole_in_the_break_makes_the_lost_skin_unseen() -> None:
    specimen, _ = broken_tip()
    middle = specimen.cloud.points_mm[specimen.on_break == 0].mean(axis=0)
    holed = blades.without(specimen, near(specimen, middle, 1.6))
    repairs = repairs_of(holed)
    assert repairs.failures
    assert coverage_of(holed, repairs)[Zone.TIP].status is CoverageStatus.UNSEEN


def test_a_break_seen_less_densely_than_coverage_asks_is_not_absent() -> None:
    specimen, repairs = broken_tip()
    (patch,) = repairs.patches
    doubtful = replace(repairs, patches=(replace(patch, broken_gap_mm=1.51),))
    assert coverage_of(specimen, doubtful)[Zone.TIP].status is CoverageStatus.UNSEEN


def test_repeated_points_add_nothing() -> None:
    at, _ = blades.suction_side_at(0.5, 30.0)
    holed = blades.without(sound(), near(sound(), at, 2.0))
    cloud = holed.cloud
    crowd = np.concatenate([np.arange(len(cloud)), np.repeat(np.arange(0, len(cloud), 7), 5)])
    crowded = replace(
        holed,
        cloud=replace(
            cloud, points_mm=cloud.points_mm[crowd], sigma_mm=cloud.sigma_mm[crowd], view=cloud.view[crowd]
        ),
    )
    assert coverage_of(crowded) == coverage_of(holed)


@pytest.mark.parametrize("seed", range(4))
def test_fewer_points_never_see_more(seed: int) -> None:
    rng = np.random.default_rng(seed)
    specimen, repairs = broken_tip()
    before = coverage_of(specimen, repairs)
    for _ in range(3):
        at = specimen.cloud.points_mm[rng.integers(len(specimen.cloud))]
        gone = near(specimen, at, rng.uniform(0.3, 4.0)) | (rng.random(len(specimen.cloud)) < 0.2)
        specimen = blades.without(specimen, gone)
        after = coverage_of(specimen, repairs)
        for zone, row in after.items():
            assert row.covered_fraction <= before[zone].covered_fraction
            assert row.largest_gap_mm >= before[zone].largest_gap_mm - 1e-6
        before = after


def test_without_a_twin_the_nominal_is_asked() -> None:
    specimen = sound()
    rows = measure_coverage(specimen.cloud, specimen.alignment, nominal(), None, None, CoverageSettings())
    assert {row.status for row in rows} == {CoverageStatus.SEEN}


def test_a_part_far_from_nominal_is_seen_on_its_twin() -> None:
    specimen = sound()
    shift = np.array([0.0, 0.9, 0.0])
    mesh = specimen.twin.mesh
    bent = replace(
        specimen,
        cloud=replace(specimen.cloud, points_mm=specimen.cloud.points_mm + shift),
        twin=replace(
            specimen.twin,
            mesh=Mesh(vertices_mm=mesh.vertices_mm + shift, faces=mesh.faces),
            displacement_mm=np.tile(shift, (len(mesh.vertices_mm), 1)),
        ),
    )
    assert Zone.SURFACE in seen(coverage_of(bent))
    alone = measure_coverage(bent.cloud, bent.alignment, nominal(), None, None, CoverageSettings())
    assert {row.zone: row.status for row in alone}[Zone.SURFACE] is CoverageStatus.UNSEEN


def test_metal_in_excess_shows_the_skin_beneath_it() -> None:
    """A weld bead; where its own top was not seen, nothing is known of what lies beneath."""
    specimen = sound()
    at_mm, outward = blades.pressure_side_at(0.5, 30.0)
    away_mm = np.linalg.norm(specimen.cloud.points_mm - at_mm, axis=1)
    lift_mm = 3.0 * np.clip(1.0 - (away_mm / 3.0) ** 2, 0.0, None)
    raised = specimen.cloud.points_mm + lift_mm[:, None] * outward
    bead = replace(specimen, cloud=replace(specimen.cloud, points_mm=raised))
    (found,) = find_damages(
        bead.cloud, np.zeros(len(raised), bool), bead.alignment, nominal(), bead.twin, DamageSettings()
    )
    assert found.kind is DamageKind.EXCESS
    assert Zone.SURFACE not in seen(coverage_of(bead))
    assert Zone.SURFACE in seen(coverage_of(bead, damages=(found,)))
    bare = blades.without(bead, away_mm < 1.5)
    (left,) = find_damages(
        bare.cloud, np.zeros(len(bare.cloud), bool), bare.alignment, nominal(), bare.twin, DamageSettings()
    )
    assert Zone.SURFACE not in seen(coverage_of(bare, damages=(left,)))


def test_no_points_at_all_is_unseen() -> None:
    nothing = blades.without(sound(), np.ones(len(sound().cloud), bool))
    rows = coverage_of(nothing)
    assert not seen(rows)
    assert all(row.covered_fraction == 0.0 and np.isfinite(row.largest_gap_mm) for row in rows.values())


def test_settings_without_sense_are_refused() -> None:
    with pytest.raises(BadInput, match="coverage"):
        CoverageSettings(min_fraction=0.0)
