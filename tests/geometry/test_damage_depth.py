"""Depth, chord left, height and spacing of damages on blades cut exactly, from dense scans to thin ones."""

from functools import cache
from itertools import product

import manifold3d
import numpy as np
import pytest

from geometry.blade.nominal import Nominal, NominalSettings, prepare_nominal
from geometry.damage import depth as losses
from geometry.damage import normal_depth
from geometry.damage.damages import Damage, find_damages
from geometry.types import Measurand, Measured, NotMeasured, Zone
from tests.geometry import repair_blades as blades

NOISE_MM = 0.012
DENSITIES = (60.0, 12.0, 3.0)  # points a square millimetre: all of a scan, every 5th, every 20th
CUTTERS = {
    "tip corner": (Zone.TIP, lambda: blades.tip_corner_cutter(8.0, 0.1)),
    "edge nick": (Zone.LEADING_EDGE, blades.edge_nick_cutter),
    "pit": (Zone.SURFACE, blades.pit_cutter),
    "deep pit": (Zone.SURFACE, lambda: blades.pit_cutter(DEEP_MM, 3.5)),
    "hole": (Zone.SURFACE, blades.hole_cutter),
}
DEEP_MM = 3.0  # more than half of the metal's thickness


@cache
def nominal() -> Nominal:
    return prepare_nominal(blades.blade_mesh(), NominalSettings(z_min_mm=1.0))


@cache
def damages(names: tuple[str, ...], per_mm2: float, seed: int) -> tuple[Damage, ...]:
    cutters = {CUTTERS[name][0]: CUTTERS[name][1]() for name in names}
    scanned = blades.specimen(cutters, NOISE_MM, np.random.default_rng(seed), per_mm2)
    mask = scanned.on_break >= 0
    return find_damages(scanned.cloud, mask, scanned.alignment, nominal(), scanned.twin)


def one(name: str, per_mm2: float, seed: int) -> Damage:
    (damage,) = damages((name,), per_mm2, seed)
    assert damage.zone is CUTTERS[name][0]
    return damage


def number(measured: Measured) -> Measurand:
    assert isinstance(measured, Measurand)
    return measured


@cache
def lost(name: str) -> manifold3d.Manifold:
    return blades.solid_of(blades.blade_mesh()) ^ CUTTERS[name][1]()


def outline(solid: manifold3d.Manifold, z_mm: float) -> blades.Array:
    return np.concatenate([np.asarray(part) for part in solid.slice(z_mm).to_polygons()])


@cache
def edge_truth() -> tuple[float, float]:
    """Largest loss along the chord at the leading edge, and the least chord left."""
    whole = blades.solid_of(blades.blade_mesh())
    rest = whole - CUTTERS["edge nick"][1]()
    rows = []
    for z_mm in np.linspace(18.5, 21.5, 61):
        le, te = blades.leading_edge_at(z_mm)[:2], blades.trailing_edge_at(z_mm)[:2]
        outward = (le - te) / np.linalg.norm(le - te)
        before, after = outline(whole, z_mm) @ outward, outline(rest, z_mm) @ outward
        rows.append((before.max() - after.max(), np.ptp(after)))
    losses, chords = np.array(rows).T
    return float(losses.max()), float(chords.min())


@cache
def thickness_mm() -> float:
    """Of the metal under the pits and about the hole."""
    _, normal = blades.pressure_side_at(0.45, 0.55 * blades.SPAN_MM)
    return float(np.ptp(blades.mesh_of(lost("hole")).vertices_mm @ normal))


def truth(name: str) -> float:
    if name == "tip corner":
        return blades.SPAN_MM - float(blades.mesh_of(lost(name)).vertices_mm[:, 2].min())
    if name == "edge nick":
        return edge_truth()[0]
    return {"pit": 1.2, "deep pit": DEEP_MM, "hole": thickness_mm()}[name]


@pytest.mark.parametrize("name", ["tip corner", "edge nick", "pit"])
def test_the_depth_is_unbiased_from_dense_to_thin_scans(name: str) -> None:
    for per_mm2 in DENSITIES:
        depths = [number(one(name, per_mm2, seed).depth_mm) for seed in range(4)]
        errors_mm = np.array([depth.value - truth(name) for depth in depths])
        sigmas_mm = np.array([depth.sigma for depth in depths])
        spacing_mm = 1.0 / np.sqrt(per_mm2)
        assert (np.abs(errors_mm) <= 3.0 * sigmas_mm).all()
        assert abs(errors_mm.mean()) <= 0.5 * spacing_mm + 0.03
        assert sigmas_mm.max() <= spacing_mm


@pytest.mark.parametrize("per_mm2", [60.0, 25.0])
def test_a_pit_is_as_deep_as_it_was_cut_where_the_other_side_is_nearer(per_mm2: float) -> None:
    assert 0.6 * thickness_mm() < DEEP_MM
    depth = number(one("deep pit", per_mm2, 0).depth_mm)
    assert depth.value == pytest.approx(DEEP_MM, abs=3.0 * depth.sigma + 0.02)


@pytest.mark.parametrize("left_mm", [0.4, 0.25, 0.15])
def test_skin_close_under_a_pit_takes_nothing_from_its_depth(left_mm: float) -> None:
    """Where hardly any metal is left, points of its other side are among the neighbours of the bottom."""
    depth_mm = thickness_mm() - left_mm
    cutters = {Zone.SURFACE: blades.pit_cutter(depth_mm, 3.5)}
    scanned = blades.specimen(cutters, NOISE_MM, np.random.default_rng(0), 25.0)
    mask = scanned.on_break >= 0
    (damage,) = find_damages(scanned.cloud, mask, scanned.alignment, nominal(), scanned.twin)
    depth = number(damage.depth_mm)
    assert depth.value == pytest.approx(depth_mm, abs=3.0 * depth.sigma + 0.02)
    assert depth.sigma < 0.05


@pytest.mark.parametrize("beyond_mm", [0.02, 0.1, 0.3])
def test_a_pit_that_pierces_the_metal_may_be_as_deep_as_that_is_thick(beyond_mm: float) -> None:
    """Its bottom ends at the skin of the other side, where noise hides how deep it still went."""
    for seed in range(3):
        depth = shallow(blades.pit_cutter(thickness_mm() + beyond_mm, 3.5), seed)
        assert depth.value == pytest.approx(thickness_mm(), abs=2.5 * depth.sigma)
        assert depth.sigma < 0.1


@pytest.mark.parametrize("per_mm2", [60.0, 25.0])
def test_a_hole_is_as_deep_as_the_metal_is_thick(per_mm2: float) -> None:
    assert number(one("hole", per_mm2, 0).depth_mm).value == pytest.approx(thickness_mm(), rel=0.06)


def test_a_break_whose_points_all_lie_on_the_far_skin_has_no_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        normal_depth, "_heights", lambda region, found, *_: np.full(len(found.scan_mm), np.nan)
    )
    scanned = blades.specimen({Zone.SURFACE: blades.pit_cutter()}, NOISE_MM, np.random.default_rng(0), 25.0)
    mask = scanned.on_break >= 0
    (damage,) = find_damages(scanned.cloud, mask, scanned.alignment, nominal(), scanned.twin)
    assert damage.depth_mm == NotMeasured(reason="0 points tell how deep it is")


@pytest.mark.parametrize("per_mm2", [3.0, 2.0])
def test_a_hole_too_small_for_a_thin_scan_is_no_shallow_pit(per_mm2: float) -> None:
    """No skin about it counts as lost: points of its wall are nearest to either side of the metal."""
    assert isinstance(one("hole", per_mm2, 0).depth_mm, NotMeasured)
    assert isinstance(one("deep pit", per_mm2, 0).depth_mm, Measurand)


@pytest.mark.parametrize(("depth_mm", "radius_mm"), [(0.15, 1.0), (0.15, 2.0), (0.6, 2.0)])
def test_noise_makes_no_bottom_deeper(depth_mm: float, radius_mm: float) -> None:
    """The deepest of few noisy points would be: by a sigma of theirs."""
    ball_mm = (radius_mm**2 + depth_mm**2) / (2.0 * depth_mm)
    depths = [shallow(blades.pit_cutter(depth_mm, ball_mm), seed) for seed in range(8)]
    errors_mm = np.array([depth.value - depth_mm for depth in depths])
    assert abs(errors_mm.mean()) < 0.004
    assert np.sqrt(np.mean(errors_mm**2)) < 0.007
    assert max(depth.sigma for depth in depths) < 0.025


def test_a_pointed_bottom_is_as_deep_as_it_is_told_within_its_uncertainty() -> None:
    at_mm, normal = blades.pressure_side_at(0.45, 0.55 * blades.SPAN_MM)
    cone = manifold3d.Manifold.cylinder(0.6, 0.0, 2.0, 160, False)
    place = np.column_stack([blades.frame_with_z(normal), at_mm - 0.3 * normal])
    for seed in range(6):
        depth = shallow(cone.transform(place), seed)
        assert depth.value == pytest.approx(0.3, abs=2.5 * depth.sigma)
        assert depth.sigma < 0.05


def shallow(cutter: manifold3d.Manifold, seed: int) -> Measurand:
    scanned = blades.specimen({Zone.SURFACE: cutter}, NOISE_MM, np.random.default_rng(seed), 60.0)
    (damage,) = find_damages(scanned.cloud, scanned.on_break >= 0, scanned.alignment, nominal(), scanned.twin)
    return number(damage.depth_mm)


@pytest.mark.parametrize(("share", "depth_mm"), [(0.8, 0.6), (0.85, 0.5), (0.9, 0.4)])
@pytest.mark.parametrize("seen", [True, False])
def test_a_pit_beside_an_edge_that_is_whole_is_as_deep_as_on_a_side(
    share: float, depth_mm: float, seen: bool
) -> None:
    """Whether or not the other side of the thin metal under it was seen."""
    cutters = {Zone.SURFACE: blades.pit_cutter(depth_mm, 2.0, share)}
    scanned = blades.specimen(cutters, NOISE_MM, np.random.default_rng(0), 25.0)
    at_mm, normal = blades.pressure_side_at(share, 0.55 * blades.SPAN_MM)
    off_mm = scanned.cloud.points_mm - at_mm
    behind = (off_mm @ normal < -0.9) & (np.linalg.norm(np.cross(off_mm, normal), axis=1) < 3.0)
    scanned = blades.without(scanned, behind & (scanned.on_break < 0) & (not seen))
    mask = scanned.on_break >= 0
    (damage,) = find_damages(scanned.cloud, mask, scanned.alignment, nominal(), scanned.twin)
    depth = number(damage.depth_mm)
    assert damage.zone is Zone.TRAILING_EDGE
    assert isinstance(damage.remaining_chord_mm, NotMeasured)
    assert depth.value == pytest.approx(depth_mm, abs=3.0 * depth.sigma)
    assert depth.sigma < 0.05


def test_a_rough_break_is_as_deep_as_it_is_told_within_its_uncertainty() -> None:
    """Waves of a millimetre across the break of a thin edge: its tail runs out where few points lie."""
    ratios = []
    for cut_mm, wave_mm in product((4.0, 14.0), (0.35, 0.9)):
        cutter = blades.tip_corner_cutter(cut_mm, wave_mm)
        metal = max(
            (blades.solid_of(blades.blade_mesh()) ^ cutter).decompose(), key=lambda part: part.volume()
        )
        true_mm = blades.SPAN_MM - float(blades.mesh_of(metal).vertices_mm[:, 2].min())
        for per_mm2, seed in product((25.0, 12.0), range(2)):
            scanned = blades.specimen({Zone.TIP: cutter}, NOISE_MM, np.random.default_rng(seed), per_mm2)
            mask = scanned.on_break >= 0
            (damage,) = find_damages(scanned.cloud, mask, scanned.alignment, nominal(), scanned.twin)
            told = number(damage.depth_mm)
            ratios.append((told.value - true_mm) / told.sigma)
    assert np.sqrt(np.mean(np.square(ratios))) <= 1.25
    assert np.abs(ratios).max() <= 3.0


def test_a_break_that_grazes_the_skin_begins_between_the_skin_and_its_last_point() -> None:
    """A slanted break across an edge: whole, and told up to 0.5 mm short of its foremost corner."""
    z_mm, spacing_mm, slant, rng = 30.0, 0.1, 0.4, np.random.default_rng(3)
    mesh = losses.between(blades.blade_mesh(), z_mm, z_mm)
    outward, edge_mm = losses._outward(nominal(), Zone.LEADING_EDGE, z_mm)
    across = np.array([-outward[1], outward[0]])
    rim_mm = losses.dense(losses.outline_mm(mesh, z_mm))
    foremost_mm, side_mm = (rim_mm @ outward).max(), (rim_mm - edge_mm) @ across
    lost = foremost_mm - rim_mm @ outward < 1.0 + slant * side_mm
    corner_mm, end_mm = side_mm[lost].min(), side_mm[lost].max()

    def loss(from_mm: float) -> tuple[float, float]:
        at_mm = rng.uniform(from_mm, end_mm, 200)
        out_mm = foremost_mm - (1.0 + slant * at_mm) - edge_mm @ outward
        xy_mm = edge_mm + at_mm[:, None] * across + out_mm[:, None] * outward
        broken_mm = np.column_stack([xy_mm, rng.uniform(z_mm - 0.5, z_mm + 0.5, 200)])
        zone = Zone.LEADING_EDGE
        return losses._section_loss(z_mm, broken_mm, nominal(), mesh, zone, spacing_mm)[:2]

    least_mm = 1.0 + slant * corner_mm
    told_mm, sigma_mm = loss(corner_mm)
    assert told_mm == pytest.approx(least_mm, abs=0.03)
    assert sigma_mm < 0.03
    told_mm, sigma_mm = loss(corner_mm + 0.5)
    assert told_mm == pytest.approx(least_mm + 0.5 * slant * 0.4, abs=0.03)
    assert sigma_mm == pytest.approx(0.5 * slant * 0.4, abs=0.03)


def test_the_chord_left_is_that_of_the_cut_section() -> None:
    for per_mm2 in DENSITIES:
        for seed in range(4):
            chord = number(one("edge nick", per_mm2, seed).remaining_chord_mm)
            assert abs(chord.value - edge_truth()[1]) <= 3.0 * chord.sigma


def test_the_height_over_the_root_is_that_of_the_lowest_metal_lost() -> None:
    for name in CUTTERS:
        low_mm = float(blades.mesh_of(lost(name)).vertices_mm[:, 2].min()) - nominal().z_min_mm
        for per_mm2 in DENSITIES:
            height = number(one(name, per_mm2, 0).above_root_mm)
            assert abs(height.value - low_mm) <= 3.0 * height.sigma + 0.02


def test_damages_know_their_distance_to_the_nearest_other() -> None:
    nick, pit = sorted(damages(("edge nick", "pit"), 12.0, 0), key=lambda damage: str(damage.zone))
    gap_mm = blades.mesh_of(lost("edge nick")).vertices_mm
    other_mm = blades.mesh_of(lost("pit")).vertices_mm
    true_mm = np.linalg.norm(gap_mm[:, None] - other_mm, axis=2).min()
    for damage in (nick, pit):
        spacing = number(damage.spacing_mm)
        assert abs(spacing.value - true_mm) <= 3.0 * spacing.sigma + 0.05
    assert not isinstance(one("pit", 12.0, 0).spacing_mm, Measurand)
