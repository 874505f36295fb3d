"""Bent metal is one damage, told from a break with a burr and from a pit with a raised rim."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree

from geometry.blade.nominal import Nominal, NominalSettings, prepare_nominal
from geometry.damage.damages import Damage, DamageKind, find_damages
from geometry.types import Floats, Measurand, NotMeasured, Zone
from tests.geometry import repair_blades as blades

NOISE_MM = 0.012
HEIGHTS_MM = np.linspace(0.0, blades.SPAN_MM, 401)


@cache
def nominal() -> Nominal:
    return prepare_nominal(blades.blade_mesh(), NominalSettings(z_min_mm=1.0))


@cache
def scanned(zone: Zone | None = None) -> blades.Specimen:
    cutters = {Zone.LEADING_EDGE: blades.edge_nick_cutter, Zone.SURFACE: blades.pit_cutter}
    cut = {} if zone is None else {zone: cutters[zone]()}
    return blades.specimen(cut, NOISE_MM, np.random.default_rng(0), 25.0)


def told(specimen: blades.Specimen, moved_mm: Floats) -> tuple[Damage, ...]:
    cloud = replace(specimen.cloud, points_mm=specimen.cloud.points_mm + moved_mm)
    none = np.zeros(len(cloud), bool)
    return find_damages(cloud, none, specimen.alignment, nominal(), specimen.twin)


def from_edge_mm(points_mm: Floats, edge_at) -> Floats:
    edge_mm = np.array([edge_at(z_mm)[:2] for z_mm in HEIGHTS_MM])
    at = np.stack([np.interp(points_mm[:, 2], HEIGHTS_MM, edge_mm[:, i]) for i in range(2)], axis=1)
    return np.asarray(np.linalg.norm(points_mm[:, :2] - at, axis=1))


def curled(points_mm: Floats) -> Floats:
    """Along the leading edge, about half of its height."""
    away_mm = from_edge_mm(points_mm, blades.leading_edge_at)
    return np.clip(1.0 - away_mm / 6.0, 0.0, None) ** 2 * np.exp(-(((points_mm[:, 2] - 20.0) / 4.0) ** 2))


def corner(points_mm: Floats) -> Floats:
    """The corner of tip and trailing edge."""
    away_mm = np.hypot(from_edge_mm(points_mm, blades.trailing_edge_at), blades.SPAN_MM - points_mm[:, 2])
    return np.clip(1.0 - away_mm / 9.0, 0.0, None) ** 2


def bent_by(shape, bend_mm: float) -> tuple[Damage, Floats]:
    """The one damage of a blade bent in a shape, and how much of the bend each point has."""
    sheet = shape(scanned().cloud.points_mm)
    (bend,) = told(scanned(), np.outer(bend_mm * sheet, [0.0, 1.0, 0.0]))
    return bend, sheet


@pytest.mark.parametrize("bend_mm", [-6.0, -1.0, 0.3, 3.0])
@pytest.mark.parametrize(("shape", "zone"), [(curled, Zone.LEADING_EDGE), (corner, Zone.TIP)])
def test_both_sides_of_bent_metal_are_one_deformation(shape, zone: Zone, bend_mm: float) -> None:
    bend, sheet = bent_by(shape, bend_mm)
    assert (bend.kind, bend.zone) == (DamageKind.DEFORMATION, zone)
    assert isinstance(bend.depth_mm, Measurand)
    assert 0.65 * abs(bend_mm) < bend.depth_mm.value < abs(bend_mm) + 2.0 * bend.depth_mm.sigma
    assert bend.span_mm[0] < scanned().cloud.points_mm[np.argmax(sheet), 2] < bend.span_mm[1] + 0.5


@pytest.mark.parametrize("bend_mm", [-0.09, 0.09, 0.12])
@pytest.mark.parametrize(("shape", "zone"), [(curled, Zone.LEADING_EDGE), (corner, Zone.TIP)])
def test_metal_bent_a_little_is_no_loss(shape, zone: Zone, bend_mm: float) -> None:
    """One side stands off enough to be found, the other a little less."""
    bend, _ = bent_by(shape, bend_mm)
    assert (bend.kind, bend.zone) == (DamageKind.DEFORMATION, zone)
    assert isinstance(bend.off_nominal_mm, Measurand)
    assert bend.off_nominal_mm.value == pytest.approx(abs(bend_mm), abs=2.0 * bend.off_nominal_mm.sigma)


@pytest.mark.parametrize("depth_mm", [0.08, 0.15, 0.4])
def test_a_shallow_pit_is_no_bend(depth_mm: float) -> None:
    """The other side of its metal is where it was."""
    shallow = blades.specimen(
        {Zone.SURFACE: blades.pit_cutter(depth_mm, 9.0)}, NOISE_MM, np.random.default_rng(1), 25.0
    )
    (pit,) = told(shallow, np.zeros(3))
    assert (pit.kind, pit.zone) == (DamageKind.MISSING, Zone.SURFACE)
    assert isinstance(pit.off_nominal_mm, NotMeasured)


@pytest.mark.parametrize("burr_mm", [0.15, 0.8])
@pytest.mark.parametrize("zone", [Zone.LEADING_EDGE, Zone.SURFACE])
def test_a_break_with_a_burr_beside_it_is_no_deformation(zone: Zone, burr_mm: float) -> None:
    """On one side of a nick, or round a pit: raised metal as large as what is lost."""
    specimen = scanned(zone)
    points_mm, broken = specimen.cloud.points_mm, specimen.on_break >= 0
    apart_mm = cKDTree(points_mm[broken]).query(points_mm)[0]
    middle_mm = np.median(points_mm[broken], axis=0)
    outward = blades.pressure_side_at(0.45, 20.0)[1]
    same_side = (points_mm - middle_mm) @ outward > -0.5
    lift_mm = burr_mm * np.clip(1.0 - apart_mm / 2.0, 0.0, None) * (~broken & same_side)
    kinds = [damage.kind for damage in told(specimen, np.outer(lift_mm, outward))]
    assert sorted(kinds) == [DamageKind.EXCESS, DamageKind.MISSING]
