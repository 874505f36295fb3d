"""Inspected sections of analytic blades: true values, honest sigmas, gaps and damages."""

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

from geometry.sections.airfoil import (
    SECTION_MEASURANDS,
    SectionStatus,
    measure_sections,
    with_damages,
)
from geometry.sections.chart import SectionSettings, outward_normals, unroll
from geometry.sections.measurands import define, form, place, shape
from geometry.transforms import exp
from geometry.types import Cloud, Measurand, NotMeasured
from tests.geometry.airfoils import AnalyticNominal, Blade, Part, alignment, cloud_of, section_of

Z = 52.5
NOMINAL = AnalyticNominal(Blade())
SETTINGS = SectionSettings()
CHART = unroll(NOMINAL, Z, 6.0, SETTINGS)


def measure(points, mask=None, pose=None, z=Z, settings=SETTINGS):
    count = len(points)
    cloud = Cloud(points_mm=points, sigma_mm=np.full(count, 0.01), view=np.zeros(count, np.int64))
    mask = np.zeros(count, bool) if mask is None else mask
    (section,) = measure_sections(cloud, mask, pose or alignment(), NOMINAL, [z], settings)
    return section


class _Truth(AnalyticNominal):
    """The true part, unrolled on the same nodes as its nominal."""

    def __init__(self, part: Part) -> None:
        super().__init__(part.blade)
        self.part = part

    def section(self, z_mm):
        return section_of(self.part.section(z_mm), self.blade.section(z_mm)[1], z_mm)


def truth_of(part):
    """True values by the definitions, from the part's own curve."""
    true = unroll(_Truth(part), Z, 0.5, SETTINGS).curve_mm
    nominal = CHART.curve_mm
    definition = define(nominal, CHART.side, SETTINGS)
    distance = CHART.project(np.column_stack([true, np.full(len(true), Z)]))[:, 1]
    found = {
        **place(true, nominal),
        **shape(true, definition),
        **form(true, distance, np.ones(len(true), bool), definition),
    }
    return {name: estimate.value for name, estimate in found.items()}


def random_part(rng):
    amplitude, phase = rng.uniform(0.0, 0.01), rng.uniform(0.0, 6.28)
    return Part(
        deviation=lambda s, z: amplitude * np.sin(2 * np.pi * 6 * s + phase + 0.02 * z),
        shift_mm=tuple(rng.normal(0.0, 0.05, 2)),
        turn_deg=rng.normal(0.0, 0.2),
    )


@cache
def one_scan():
    part = random_part(np.random.default_rng(11))
    points = part.scan(np.random.default_rng(12), 44.0, 61.0, 0.2, 0.015)
    return part, points, CHART.arc_at(CHART.project(points)[:, 0])


def test_values_are_true_within_four_sigma():
    part, points, _ = one_scan()
    section, truth = measure(points), truth_of(part)
    assert section.status is SectionStatus.MEASURED
    assert section.reason is None
    assert set(section.measurands) == set(SECTION_MEASURANDS)
    for name, value in truth.items():
        found = section.measurands[name]
        assert isinstance(found, Measurand)
        assert abs(found.value - value) <= 4.0 * found.sigma, name
        assert found.sigma < 0.005, name


def test_nominal_values_are_those_of_the_definitions():
    nominals = measure(one_scan()[1]).nominals
    assert set(nominals) == set(SECTION_MEASURANDS)
    scale = 1.0 - 0.12 * Z / 105.0
    assert nominals["le_radius_mm"] == pytest.approx(0.8 * scale, rel=2e-3)
    assert nominals["te_radius_mm"] == pytest.approx(0.45 * scale, rel=2e-3)
    assert nominals["position_mm"] == nominals["orientation_deg"] == nominals["profile_max_mm"] == 0.0
    assert nominals["stagger_deg"] == pytest.approx(12.5, abs=0.6)


@pytest.mark.parametrize(("shift", "turn"), [((0.1, 0.0), 0.0), ((0.0, -0.1), 0.0), ((0.0, 0.0), 0.5)])
def test_signs_of_position_and_orientation(shift, turn):
    points = Part(shift_mm=shift, turn_deg=turn).scan(np.random.default_rng(1), 44.0, 61.0, 0.4, 0.01)
    m = measure(points).measurands
    assert m["position_x_mm"].value == pytest.approx(shift[0], abs=0.005)
    assert m["position_y_mm"].value == pytest.approx(shift[1], abs=0.003)
    assert m["orientation_deg"].value == pytest.approx(turn, abs=0.006)


@pytest.mark.timeout(400)
def test_sigmas_are_honest():
    """Error over sigma has a standard deviation of one, over random parts, noises and samplings."""
    names = [name for name in SECTION_MEASURANDS if name != "position_mm"]
    ratios = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        part = random_part(rng)
        section, truth = measure(part.scan(rng, 46.0, 59.0, 0.4, 0.02)), truth_of(part)
        found = [section.measurands[name] for name in names]
        ratios.append([(m.value - truth[m.name]) / max(m.sigma, 1e-9) for m in found])
    spread = dict(zip(names, np.std(ratios, axis=0), strict=True))
    for name in ("position_x_mm", "position_y_mm", "orientation_deg", "chord_mm", "max_thickness_mm"):
        assert 0.8 < spread[name] < 1.25, spread
    at_most = ("le_flat_mm", "te_flat_mm", "out_of_tolerance_fraction")  # their sigmas are bounds
    for name in names:
        assert (0.0 if name in at_most else 0.5) <= spread[name] < 1.4, (name, spread[name])


def test_the_pose_is_part_of_the_sigmas():
    """Poses drawn from a covariance spread the values as the added variance says."""
    _, points, _ = one_scan()
    points = points[::3]
    sd = np.array([2e-4, 2e-4, 1e-4, 0.004, 0.003, 0.01])
    pose = alignment(information=np.diag(sd**-2.0))
    rng = np.random.default_rng(3)
    names = ["position_x_mm", "position_y_mm", "orientation_deg"]
    extremes = ["profile_max_mm", "profile_min_mm"]
    alone, both = measure(points).measurands, measure(points, pose=pose).measurands
    values = []
    for _ in range(30):
        T = exp(rng.normal(0.0, 1.0, 6) * sd, pose.pivot_mm)
        moved = measure(points, pose=alignment(T=T)).measurands
        values.append([moved[name].value for name in names + extremes])
    for name, spread in zip(names, np.std(values, axis=0), strict=False):
        added = np.sqrt(both[name].sigma ** 2 - alone[name].sigma ** 2)
        assert added == pytest.approx(spread, rel=0.35, abs=2e-4), name
    for name, found in zip(extremes, np.transpose(values)[-2:], strict=True):
        off = np.sqrt(np.mean((found - both[name].value) ** 2))
        assert 0.6 < off / both[name].sigma < 1.25, name


def test_a_free_direction_of_the_pose_is_finite_and_large():
    information = np.diag([1e8, 1e8, 1e8, 1e6, 0.0, 1e6])
    m = measure(one_scan()[1], pose=alignment(information=information)).measurands
    assert m["position_y_mm"].sigma == pytest.approx(1.0, rel=0.05)
    assert m["position_x_mm"].sigma < 0.1


def test_profile_extremes_and_points():
    part = Part(deviation=lambda s, z: 0.05 * np.sin(2 * np.pi * 2 * s) + 0.0 * z)
    section = measure(part.scan(np.random.default_rng(5), 44.0, 61.0, 0.25, 0.01))
    assert section.measurands["profile_max_mm"].value == pytest.approx(0.05, abs=0.002)
    assert section.measurands["profile_min_mm"].value == pytest.approx(-0.05, abs=0.002)
    assert section.profile_mm.shape == (len(section.deviation_mm), 2)
    assert (section.run == 0).all()
    assert section.covered_fraction == 1.0


def arc_window(arc, start, stop):
    return (arc > start) & (arc < stop)


def test_a_void_is_not_measured_and_not_a_damage():
    _, points, arc = one_scan()
    section = measure(points[~arc_window(arc, 18.0, 24.0)])
    assert section.status is SectionStatus.PARTIAL
    assert section.covered_fraction == pytest.approx(1.0 - 6.0 / CHART.perimeter_mm, abs=0.01)
    for name in ("position_mm", "orientation_deg", "profile_max_mm", "max_thickness_mm"):
        lost = section.measurands[name]
        assert isinstance(lost, NotMeasured)
        assert not lost.in_damage
    for name in ("chord_mm", "le_radius_mm", "te_radius_mm", "stagger_deg"):
        assert isinstance(section.measurands[name], Measurand)


def test_nothing_is_drawn_across_a_void():
    _, points, arc = one_scan()
    section = measure(points[~arc_window(arc, 18.0, 24.0) & ~arc_window(arc, 60.0, 63.0)])
    assert set(section.run) == {0, 1}
    for number in (0, 1):
        stretch = section.profile_mm[section.run == number]
        assert np.linalg.norm(np.diff(stretch, axis=0), axis=1).max() < 0.1
    seen = CHART.arc_at(
        CHART.project(np.column_stack([section.profile_mm, np.full(len(section.run), Z)]))[:, 0]
    )
    assert not arc_window(seen, 18.5, 23.5).any()
    assert not arc_window(seen, 60.5, 62.5).any()


def edge_nick():
    """Points damaged within 3 mm of arc of the leading edge and 3 mm of the plane."""
    _, points, arc = one_scan()
    le = CHART.arc_mm[len(CHART.curve_mm) // 2]
    return points, (np.abs(arc - le) < 3.0) & (np.abs(points[:, 2] - Z) < 3.0)


def test_a_masked_nick_puts_what_needs_that_edge_in_damage():
    points, mask = edge_nick()
    section = measure(points, mask)
    assert section.status is SectionStatus.IN_DAMAGE
    for name in ("le_radius_mm", "chord_mm", "position_mm", "orientation_deg", "profile_min_mm"):
        lost = section.measurands[name]
        assert isinstance(lost, NotMeasured)
        assert lost.in_damage, name
    for name in ("te_radius_mm", "max_thickness_mm"):
        assert isinstance(section.measurands[name], Measurand)


def test_a_nick_whose_metal_is_gone_is_known_by_its_rim():
    points, mask = edge_nick()
    hole = mask & (np.abs(points[:, 2] - Z) < 2.0)
    section = measure(points[~hole], mask[~hole])
    assert section.status is SectionStatus.IN_DAMAGE
    assert section.measurands["le_radius_mm"].in_damage


def test_scattered_masked_points_do_not_make_a_damage():
    _, points, _ = one_scan()
    section = measure(points, np.random.default_rng(0).random(len(points)) < 0.05)
    assert section.status is SectionStatus.MEASURED


def broken_tip(break_mm=45.0):
    """The blade ends below the section; its broken surface is seen."""
    rng = np.random.default_rng(4)
    below = Part().scan(rng, 30.0, break_mm, 0.3, 0.015)
    curve = NOMINAL.section(break_mm).curve_mm
    t = rng.uniform(0.0, 1.0, (2, 3000))
    i = rng.integers(0, len(curve), 3000)
    half = len(curve) // 2
    inside = curve[i] * (1.0 - t[0])[:, None] + curve[(2 * half - i) % len(curve)] * t[0][:, None]
    surface = np.column_stack([inside, break_mm + rng.normal(0.0, 0.1, 3000)])
    return below, surface


def test_a_section_above_a_broken_tip_is_in_damage():
    below, surface = broken_tip()
    points = np.vstack([below, surface])
    mask = np.arange(len(points)) >= len(below)
    section = measure(points, mask)
    assert section.status is SectionStatus.IN_DAMAGE
    assert all(isinstance(m, NotMeasured) and m.in_damage for m in section.measurands.values())
    assert len(section.profile_mm) == 0
    assert section.covered_fraction == 0.0


def test_a_section_above_the_end_of_a_scan_is_not_covered():
    below, _ = broken_tip()
    section = measure(below)
    assert section.status is SectionStatus.NOT_COVERED
    assert all(isinstance(m, NotMeasured) and not m.in_damage for m in section.measurands.values())


def test_known_damages_explain_what_is_missing():
    _, points, arc = one_scan()
    section = measure(points[~arc_window(arc, 18.0, 24.0)])
    assert with_damages(section, touched=False) is section
    told = with_damages(section, touched=True)
    assert told.status is SectionStatus.IN_DAMAGE
    assert told.measurands["position_mm"].in_damage
    assert told.measurands["chord_mm"] is section.measurands["chord_mm"]
    whole = measure(points)
    assert with_damages(whole, touched=True) is whole


def test_fewer_points_never_measure_more():
    """Deleting points may lose measurands and widen sigmas; it never gains any."""
    _, points, arc = one_scan()
    rng = np.random.default_rng(9)
    keep = np.ones(len(points), bool)
    before = measure(points)
    for _ in range(6):
        start = rng.uniform(0.0, 80.0)
        keep &= ~(arc_window(arc, start, start + 4.0) & (np.abs(points[:, 2] - Z) < rng.uniform(0.3, 5.0)))
        after = measure(points[keep])
        for name, old in before.measurands.items():
            new = after.measurands[name]
            if isinstance(old, NotMeasured):
                assert isinstance(new, NotMeasured), name
            elif isinstance(new, Measurand):
                assert new.sigma > 0.8 * old.sigma, name
        assert after.covered_fraction <= before.covered_fraction + 1e-5  # a micrometre of arc
        before = after


def test_order_of_points_does_not_matter():
    _, points, _ = one_scan()
    points = points[:15000]
    turned = np.random.default_rng(2).permutation(len(points))
    a, b = measure(points).measurands, measure(points[turned]).measurands
    for name, value in a.items():
        assert_allclose(b[name].value, value.value, atol=max(value.sigma, 1e-6), err_msg=name)


def test_sections_come_in_the_order_asked_for():
    part = Part()
    points = part.scan(np.random.default_rng(6), 0.0, 105.0, 0.4, 0.01)
    cloud = Cloud(points_mm=points, sigma_mm=np.full(len(points), 0.01), view=np.zeros(len(points), np.int64))
    heights = [98.0, 0.0, 105.0, 7.0]
    sections = measure_sections(cloud, np.zeros(len(points), bool), alignment(), NOMINAL, heights, SETTINGS)
    assert [s.z_mm for s in sections] == heights
    assert {s.status for s in sections} == {SectionStatus.MEASURED}


class _Filleted(AnalyticNominal):
    """The blade swells into its root by a fillet of 4 mm radius."""

    def section(self, z_mm):
        curve, le = self.blade.section(z_mm)
        swell = 4.0 - np.sqrt(16.0 - (4.0 - z_mm) ** 2) if z_mm < 4.0 else 0.0
        return section_of(curve + outward_normals(curve) * swell, le, z_mm)


def test_a_section_in_the_root_fillet_is_measured_without_bias():
    nominal = _Filleted(Blade())
    rng = np.random.default_rng(8)
    points = []
    for z in rng.uniform(0.0, 9.0, 500):
        curve = nominal.section(float(z)).curve_mm
        points.append(np.column_stack([curve[rng.integers(0, len(curve), 60)], np.full(60, z)]))
    cloud = cloud_of(np.vstack(points) + rng.normal(0.0, 0.005, (30000, 3)), 0.005)
    (section,) = measure_sections(cloud, np.zeros(30000, bool), alignment(), nominal, [2.5], SETTINGS)
    for name, value in section.nominals.items():
        found = section.measurands[name]
        assert abs(found.value - value) < max(4.0 * found.sigma, 0.001), name


@pytest.mark.parametrize("half_z_mm", [1.5, 50.0])
def test_a_bump_too_narrow_to_be_followed_is_in_the_sigma_of_the_extreme(half_z_mm):
    """One of 0.03 mm, a millimetre wide: smoothing all sides alike takes most of it off."""

    def bump(s, z):
        return 0.03 * np.exp(-(((s - 0.3) * 200.0) ** 2) - ((z - Z) / half_z_mm) ** 2)

    part = Part(deviation=bump)
    true_mm = truth_of(part)["profile_max_mm"]
    for seed in range(3):
        section = measure(part.scan(np.random.default_rng(seed), 40.5, 64.5, 0.2, 0.01))
        found = section.measurands["profile_max_mm"]
        assert abs(found.value - true_mm) <= 3.0 * found.sigma


def test_noise_alone_flattens_no_extreme():
    """Half of the extremes lie where noise leaves something over; none is told to be far off elsewhere."""
    for seed in range(3):
        section = measure(Part().scan(np.random.default_rng(seed), 40.5, 64.5, 0.2, 0.01))
        for name in ("profile_max_mm", "profile_min_mm", "ss_profile_max_mm", "le_profile_min_mm"):
            assert section.measurands[name].sigma <= 0.005
