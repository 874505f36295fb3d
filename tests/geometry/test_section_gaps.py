"""Gaps of any width anywhere: nothing is reported across them, and fewer points never make a part better."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geometry.sections.airfoil import measure_sections
from geometry.sections.chart import NODES, SectionSettings, unroll
from geometry.sections.measurands import define
from geometry.sections.profile import cover_zones
from geometry.types import Measurand, NotMeasured
from station.verdict import Word, judge
from tests.geometry.airfoils import AnalyticNominal, Blade, Part, cloud_of
from tests.geometry.test_airfoil import alignment
from tests.station.parts import GATES, measurement, plan

Z = 52.5
NOMINAL, SETTINGS = AnalyticNominal(Blade()), SectionSettings()
CHART = unroll(NOMINAL, Z, 12.0, SETTINGS)
SUPPORTS = define(CHART.curve_mm, CHART.side, SETTINGS).supports()
PARTS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.4)  # of the perimeter
WORST_MM = 0.3 * CHART.perimeter_mm


def bump(s, z):
    """0.15 mm of excess on 8 mm of arc about WORST_MM."""
    return 0.15 * np.exp(-(((s - 0.3) * CHART.perimeter_mm / 3.0) ** 2)) + 0.0 * z


@cache
def scanned():
    points = Part(deviation=bump).scan(np.random.default_rng(3), 46.0, 59.0, 0.15, 0.012)
    return points, CHART.arc_at(CHART.project(points)[:, 0])


def measure(points):
    clear = np.zeros(len(points), bool)
    (section,) = measure_sections(cloud_of(points, 0.01), clear, alignment(), NOMINAL, [Z], SETTINGS)
    return section


def without(start_mm, width_mm):
    """The scan without the points on an arc, and the nodes well inside that arc."""
    points, arc = scanned()
    gone = (arc - start_mm) % CHART.perimeter_mm < width_mm
    inside = (CHART.arc_mm[:-1] - start_mm - 0.1) % CHART.perimeter_mm < width_mm - 0.2
    return points[~gone], inside


@cache
def measured_without(start_mm, width_mm):
    return measure(without(start_mm, width_mm)[0])


def gaps():
    rng = np.random.default_rng(5)
    anywhere = [(rng.uniform(0.0, CHART.perimeter_mm), part) for part in PARTS]
    over_the_worst = [(WORST_MM - 0.5 * part * CHART.perimeter_mm, part) for part in PARTS]
    return anywhere + over_the_worst


@pytest.mark.parametrize(("start_mm", "part"), gaps())
def test_nothing_is_reported_across_a_gap(start_mm, part):
    width = part * CHART.perimeter_mm
    _, inside = without(start_mm, width)
    section = measured_without(start_mm, width)
    for name, support in SUPPORTS.items():
        if (support & inside).any():
            assert isinstance(section.measurands[name], NotMeasured), name
    assert section.stacking is None
    assert section.covered_fraction == pytest.approx(1.0 - part, abs=0.02)
    assert max(zone.largest_gap_mm for zone in section.zones.values()) <= width + 1.5


@pytest.mark.parametrize(("start_mm", "part"), gaps())
def test_what_was_proven_bad_is_never_proven_good_with_fewer_points(start_mm, part):
    before, after = _whole(), measured_without(start_mm, part * CHART.perimeter_mm)
    for name, old in before.measurands.items():
        new = after.measurands[name]
        if isinstance(old, Measurand) and isinstance(new, Measurand):
            nominal = before.nominals[name]
            least = abs(old.value - nominal) - 3.0 * old.sigma
            assert abs(new.value - nominal) + 3.0 * new.sigma >= least, name
        else:
            assert isinstance(new, NotMeasured), name


@cache
def _whole():
    return measure(scanned()[0])


def limits(serviceable, repairable):
    """Limits of the profile, with others that the part is well inside."""
    wide = {"serviceable": 1.0, "repairable": 2.0}
    others = dict.fromkeys(("position_mm", "orientation_deg", "chord_mm", "max_thickness_mm"), wide)
    return {"section": {**others, "profile_mm": {"serviceable": serviceable, "repairable": repairable}}}


PLANS = {
    Word.SCRAP: plan(limits(0.05, 0.1), (Z,)),
    Word.REPAIR: plan(limits(0.1, 0.4), (Z,)),
    Word.PASS: plan(limits(0.2, 0.4), (Z,)),
}


def words(points):
    """The station's verdict by each plan on a blade that this section alone can fail."""
    seen = measurement(sections=(measure(points),))
    return {truth: judge(seen, each, GATES).verdict for truth, each in PLANS.items()}


@cache
def sparse():
    points = Part(deviation=bump).scan(np.random.default_rng(8), 48.0, 57.0, 0.3, 0.012)
    return points, CHART.arc_at(CHART.project(points)[:, 0])


def test_the_whole_scan_has_the_verdict_of_its_plan():
    assert words(sparse()[0]) == {truth: truth for truth in PLANS}


@settings(max_examples=10, deadline=None, derandomize=True)
@given(
    start=st.one_of(st.just(None), st.floats(0.0, 1.0)),
    part=st.floats(0.01, 0.4),
    share=st.sampled_from([1.0, 1.0, 0.5, 0.2, 0.05, 0.01]),
    seed=st.integers(0, 99),
)
def test_deleting_points_never_makes_a_verdict_better(start, part, share, seed):
    """A gap anywhere (None: over the worst deviation) and points thinned at random leave SCRAP and REPAIR as
    they are or make them HOLD; a gap leaves nothing to PASS either."""
    points, arc = sparse()
    perimeter = CHART.perimeter_mm
    low = WORST_MM - 0.5 * part * perimeter if start is None else start * perimeter
    kept = (arc - low) % perimeter >= part * perimeter
    kept &= np.random.default_rng(seed).random(len(points)) < share
    found = words(points[kept])
    assert all(word in (truth, Word.HOLD) for truth, word in found.items())
    if part * perimeter > SETTINGS.max_gap_mm:
        assert set(found.values()) == {Word.HOLD}


@settings(max_examples=4, deadline=None, derandomize=True)
@given(share=st.floats(0.3, 1.0), seed=st.integers(0, 99))
def test_what_a_gap_holds_back_is_held_back_with_fewer_points(share, seed):
    points, arc = sparse()
    kept = (arc - WORST_MM + 2.0) % CHART.perimeter_mm >= 4.0
    kept &= np.random.default_rng(seed).random(len(points)) < share
    assert set(words(points[kept]).values()) == {Word.HOLD}


def test_zones_are_covered_by_arc_length_not_by_count():
    """Points crowded on one side do not make up for those that lack on the other."""
    side, arc = CHART.side, CHART.arc_mm[:-1]
    crowded = np.concatenate([arc[side == 1], arc[side == 1] + 1e-3, arc[side == 3][:: NODES // 16]])
    zones = cover_zones(CHART.curve_mm, side, crowded, 1.5)
    assert zones[1].covered_fraction > 0.99
    assert zones[3].covered_fraction == 0.0
    assert zones[3].largest_gap_mm > 1.5


def test_the_gap_of_a_zone_is_its_own_part_of_a_gap():
    """A gap over an edge counts in the edge and in both sides, each as far as it reaches there."""
    side, arc = CHART.side, CHART.arc_mm[:-1]
    step = np.diff(CHART.arc_mm)
    nose = CHART.arc_mm[NODES // 2]
    seen = arc[np.abs(arc - nose) > 6.0]
    zones = cover_zones(CHART.curve_mm, side, seen, 1.5)
    total = sum(zone.largest_gap_mm for zone in (zones[0], zones[1], zones[3]))
    assert total == pytest.approx(12.0, abs=0.2)
    assert zones[0].covered_fraction == pytest.approx(0.0, abs=1e-9)
    assert zones[0].largest_gap_mm == pytest.approx(step[side == 0].sum(), abs=1e-6)
    assert zones[2].covered_fraction == 1.0


def test_no_points_cover_nothing():
    for zone in cover_zones(CHART.curve_mm, CHART.side, np.empty(0), 1.5):
        assert zone.covered_fraction == 0.0
        assert zone.largest_gap_mm > 0.0
