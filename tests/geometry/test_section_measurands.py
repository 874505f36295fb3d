"""Chords, edge shape, camber, waviness and best fits against closed forms, and their gradients."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from geometry.errors import BadInput, CannotMeasure
from geometry.sections.camber import max_camber, thickest_at
from geometry.sections.chart import NODES, FitSettings, SectionSettings, outward_normals, unroll
from geometry.sections.chords import chord, hollow, nose_tail_chord, tangent_chord
from geometry.sections.curve import camber_line, centroid, edge, node_arc, node_shares, thick_part, thickness
from geometry.sections.edge_shape import flat, min_radius
from geometry.sections.form import highest_sigma, share_beyond, share_beyond_sigma, wave_band
from geometry.sections.measurands import SECTION_MEASURANDS, define, section_measurands, shape
from geometry.sections.section_fit import best_fit
from tests.geometry.airfoils import AnalyticNominal, Blade, DiscAirfoil

NOSE = NODES // 2


def turned(curve, turn_deg):
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    return curve @ np.array([[c, s], [-s, c]])


def chart_of(airfoil):
    blade = Blade(airfoil=airfoil, twist_deg=0.0, taper=0.0)
    return unroll(AnalyticNominal(blade), 50.0, 1.0, SectionSettings())


def ends_of(curve):
    return edge(curve, NOSE), edge(curve, 0)


BENT, STRAIGHT = DiscAirfoil(), DiscAirfoil(camber_mm=0.0)
CURVE = chart_of(BENT).curve_mm
ENDS = ends_of(CURVE)
DOWN = hollow(CURVE, *ENDS)


@pytest.mark.parametrize("turn_deg", [0.0, 77.0, -160.0])
def test_nose_and_tail_lie_where_the_camber_line_leaves_the_edges(turn_deg):
    """4 % of the perimeter from its end, a parabola of span s has the slope 4 h / s (1 - 2 t)."""
    curve = turned(CURVE, turn_deg)
    line = nose_tail_chord(curve, *ends_of(curve))
    slope = np.arctan(4.0 * 4.0 / 44.0 * (1.0 - 2.0 * 0.04 * 2.1))
    out = np.array([np.cos(slope), np.sin(slope)])
    nose = -0.8 * out
    tail = np.array([44.0, 0.0]) + 0.45 * out * [1.0, -1.0]
    assert line.length.value == pytest.approx(np.linalg.norm(tail - nose), abs=1e-2)


def test_chords_of_a_straight_airfoil_are_one():
    curve = chart_of(STRAIGHT).curve_mm
    le, te = ends_of(curve)
    assert nose_tail_chord(curve, le, te).length.value == pytest.approx(44.0 + 0.8 + 0.45, abs=2e-5)
    with pytest.raises(CannotMeasure, match="hollow"):
        hollow(curve, le, te)


@pytest.mark.parametrize("turn_deg", [0.0, 130.0])
def test_the_tangent_chord_is_that_of_the_two_end_discs(turn_deg):
    """The straight edge touches both end discs from below: along it the section is as long as they reach."""
    curve = turned(CURVE, turn_deg)
    le, te = ends_of(curve)
    lean = np.arcsin((0.8 - 0.45) / 44.0)
    found = tangent_chord(curve, le, te, hollow(curve, le, te))
    assert found.value == pytest.approx(44.0 * np.cos(lean) + 0.8 + 0.45, abs=1e-4)


def test_no_chord_is_longer_than_the_caliper_chord():
    caliper = chord(CURVE, *ENDS).line.length.value
    assert nose_tail_chord(CURVE, *ENDS).length.value <= caliper + 1e-6
    assert tangent_chord(CURVE, *ENDS, DOWN).value <= caliper + 1e-6


@pytest.mark.parametrize("radius_mm", [0.3, 0.8])
def test_the_flat_of_a_circle_is_its_chord_of_that_bulge(radius_mm):
    curve = chart_of(DiscAirfoil(le_mm=radius_mm)).curve_mm
    expected = 2.0 * np.sqrt(2.0 * radius_mm * 0.005 - 0.005**2)
    assert flat(curve, edge(curve, NOSE), 0.005).value == pytest.approx(expected, rel=0.03)


def blunted(depth_mm):
    """The section with its leading edge cut straight, `depth_mm` deep, and the width of the cut."""
    le = ENDS[0]
    direction = le.direction(CURVE)
    reach = float((CURVE[le.zone] @ direction).max()) - depth_mm
    over = np.zeros(NODES)
    over[le.zone] = np.maximum(CURVE[le.zone] @ direction - reach, 0.0)
    return CURVE - over[:, None] * direction, 2.0 * np.sqrt(2.0 * 0.8 * depth_mm - depth_mm**2)


def test_a_cut_edge_is_flat_as_far_as_it_is_cut():
    curve, width = blunted(0.05)
    assert flat(curve, ENDS[0], 0.005).value == pytest.approx(width, rel=0.25)
    assert flat(curve, ENDS[0], 0.005).value > 2.0 * flat(CURVE, ENDS[0], 0.005).value
    assert min_radius(curve, ENDS[0], 0.4).value < 0.6


def test_the_smallest_radius_of_a_round_edge_is_its_radius():
    for end, radius in zip(ENDS, (0.8, 0.45), strict=True):
        assert min_radius(CURVE, end, 0.5 * radius).value == pytest.approx(radius, rel=0.01)


def test_max_camber_is_that_of_the_camber_line():
    line = nose_tail_chord(CURVE, *ENDS)
    curve, _ = BENT.curve()
    t = np.linspace(0.0, 1.0, 4001)
    parabola = np.column_stack([44.0 * t, 16.0 * t * (1.0 - t)]) - centroid(curve)
    across = np.array([-line.along[1], line.along[0]])
    expected = np.abs((parabola - line.nose_mm) @ across).max()
    assert 4.0 < expected < 4.3
    found = max_camber(CURVE, camber_line(CURVE, NOSE), line)
    assert found.value == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize("at", [400, 512, 1500])
def test_a_nick_hardly_moves_max_camber(at):
    dent = np.exp(-((np.linalg.norm(CURVE - CURVE[at], axis=1) / 0.6) ** 2))
    curve = CURVE - outward_normals(CURVE) * 0.4 * dent[:, None]
    line = nose_tail_chord(CURVE, *ENDS)
    sound = max_camber(CURVE, camber_line(CURVE, NOSE), line).value
    assert max_camber(curve, camber_line(curve, NOSE), line).value == pytest.approx(sound, abs=0.004)


def test_where_it_is_thickest_is_where_the_largest_disc_is():
    curve = chart_of(STRAIGHT).curve_mm
    le, te = ends_of(curve)
    pair = thick_part(camber_line(curve, NOSE))
    t = np.linspace(0.0, 1.0, 20001)
    largest = 44.0 * t[np.argmax(STRAIGHT.discs(t)[1])] + 0.8
    assert thickest_at(curve, pair, nose_tail_chord(curve, le, te)).value == pytest.approx(largest, abs=0.05)


def test_the_stagger_of_a_blade_that_points_backwards_is_near_its_nominal():
    chart = chart_of(BENT)
    stagger_deg = define(chart.curve_mm, chart.side, SectionSettings()).nominals["stagger_deg"]
    backwards = turned(chart.curve_mm, 179.9 - stagger_deg)
    definition = define(backwards, chart.side, SectionSettings())
    assert definition.nominals["stagger_deg"] == pytest.approx(179.9)
    found = shape(turned(chart.curve_mm, 180.2 - stagger_deg), definition)["stagger_deg"]
    assert found.value == pytest.approx(180.2, abs=1e-3)


def test_thickness_at_a_distance_is_that_of_the_disc_there():
    chart = chart_of(STRAIGHT)
    found = shape(chart.curve_mm, define(chart.curve_mm, chart.side, SectionSettings()))
    for distance in (2.0, 4.0):
        radius = STRAIGHT.discs(np.array([(distance - 0.8) / 44.0]))[1][0]
        assert found[f"le_thickness_at_{distance:g}_mm"].value == pytest.approx(2.0 * radius, abs=0.02)


def test_asked_for_distances_are_named():
    names = section_measurands(SectionSettings(edge_distances_mm=(1.5, 3.0)))
    assert {"le_thickness_at_1.5_mm", "te_thickness_at_3_mm"} <= set(names)
    assert set(SECTION_MEASURANDS) > {"profile_max_mm", "le_flat_mm", "fit_rotation_deg"}


def test_a_straight_airfoil_has_no_tangent_chord_and_its_nominal_says_so():
    chart = chart_of(STRAIGHT)
    nominals = define(chart.curve_mm, chart.side, SectionSettings()).nominals
    assert "chord_tangent_mm" not in nominals
    assert nominals["max_camber_mm"] == pytest.approx(0.0, abs=1e-3)


def smooth_bumps():
    t = 2.0 * np.pi * np.arange(NODES) / NODES
    return [1e-5 * np.cos(k * t + phase) for k, phase in ((1, 0.3), (3, 1.0), (8, 2.0))]


@pytest.mark.parametrize("bump", smooth_bumps())
@pytest.mark.parametrize(
    "measure",
    [
        lambda c: nose_tail_chord(c, *ENDS).length,
        lambda c: tangent_chord(c, *ENDS, DOWN),
        lambda c: max_camber(c, camber_line(c, NOSE), nose_tail_chord(c, *ENDS)),
        lambda c: best_fit(c, CURVE, chart_of(BENT).side, FitSettings()).rotation,
        lambda c: best_fit(c, CURVE, chart_of(BENT).side, FitSettings(le=0.0, locked=frozenset({"y"}))).x,
    ],
    ids=["nose-tail", "tangent", "camber", "fit rotation", "fit x"],
)
def test_gradients_foretell_what_small_deviations_do(measure, bump):
    push = outward_normals(CURVE) * bump[:, None]
    expected = (measure(CURVE + push).value - measure(CURVE - push).value) / 2.0
    assert measure(CURVE).gradient @ bump == pytest.approx(expected, rel=0.08, abs=3e-7)


SIDE = chart_of(BENT).side


def test_a_best_fit_finds_a_motion_and_leaves_nothing():
    moved = turned(CURVE - CURVE.mean(axis=0), 0.4) + CURVE.mean(axis=0) + np.array([0.05, -0.03])
    fit = best_fit(moved, CURVE, SIDE, FitSettings())
    assert np.rad2deg(fit.rotation.value) == pytest.approx(0.4, abs=1e-4)
    assert np.abs(fit.form_mm).max() < 1e-4


def test_what_is_locked_does_not_move():
    moved = CURVE + np.array([0.05, -0.03])
    fit = best_fit(moved, CURVE, SIDE, FitSettings(locked=frozenset({"x", "rotation"})))
    assert fit.x.value == fit.rotation.value == 0.0
    assert not fit.x.gradient.any()
    assert fit.y.value == pytest.approx(-0.03, abs=2e-3)


def test_a_side_without_weight_does_not_pull():
    bulge = np.where(SIDE == 1, 0.05, 0.0)
    curve = CURVE + outward_normals(CURVE) * bulge[:, None]
    fit = best_fit(curve, CURVE, SIDE, FitSettings(suction=0.0))
    assert abs(fit.x.value) + abs(fit.y.value) < 1e-4
    assert fit.form_mm[SIDE == 1].max() == pytest.approx(0.05, abs=1e-4)


def test_settings_of_a_fit_are_checked():
    with pytest.raises(BadInput):
        FitSettings(le=-1.0)
    with pytest.raises(BadInput):
        FitSettings(le=0.0, suction=0.0, te=0.0, pressure=0.0)


def test_waviness_is_the_sine_in_its_band_and_nothing_else():
    share = node_shares(CURVE)
    arc, perimeter = node_arc(CURVE), float(share.sum())
    wave = 0.01 * np.sin(2.0 * np.pi * 12 * arc / perimeter)
    rest = 0.2 * np.sin(2.0 * np.pi * 2 * arc / perimeter) + 0.05
    band = wave_band(arc, share, (2.5, 15.0))
    assert_allclose(band.waves(wave + rest), wave, atol=1e-6)
    assert band.rms(wave + rest).value == pytest.approx(0.01 / np.sqrt(2.0), rel=2e-3)
    assert band.height(wave + rest).value == pytest.approx(0.02, rel=3e-3)


def test_the_share_out_of_tolerance_is_that_of_the_arc():
    share = node_shares(CURVE)
    arc = np.cumsum(share) / share.sum()
    slope = 0.2 * arc
    assert share_beyond(slope, share, 0.1) == pytest.approx(0.5, abs=1e-3)
    sigma = share_beyond_sigma(slope, np.full(NODES, 0.01), share, 0.1)
    assert sigma == pytest.approx(0.05, abs=2e-3)


@pytest.mark.parametrize("rest", [0.05, 0.04, 0.02])
def test_the_sigma_of_an_extreme_knows_of_the_nodes_that_a_turn_lifts_past_it(rest):
    """The highest node lies where a turn moves nothing; the ends, `rest` high, go up and down with it."""
    arm = np.linspace(-1.0, 1.0, NODES)
    deviation = np.maximum(0.05 - np.abs(arm), rest)
    growth, everywhere = 0.02 * arm, np.ones(NODES, bool)
    turns = np.random.default_rng(0).normal(size=2000)
    farthest = (deviation + growth * turns[:, None]).max(axis=1)
    off = np.sqrt(np.mean((farthest - deviation.max()) ** 2))
    assert 0.95 * off - 2e-3 <= highest_sigma(deviation, everywhere, np.abs(growth)) <= 1.5 * off


def test_the_sigma_of_an_extreme_is_that_of_its_node_where_no_other_comes_near():
    deviation, sigma = np.zeros(NODES), np.full(NODES, 0.004)
    deviation[3], sigma[3] = 0.1, 0.002
    assert highest_sigma(deviation, np.ones(NODES, bool), sigma) == pytest.approx(0.002)
    assert highest_sigma(deviation, np.arange(NODES) > 3, sigma) == pytest.approx(0.004)


def test_largest_thickness_and_its_place_come_from_the_same_part():
    pair = thick_part(camber_line(CURVE, NOSE))
    place = thickest_at(CURVE, pair, nose_tail_chord(CURVE, *ENDS)).value
    centres = CURVE[pair.node] - 0.5 * thickness(CURVE, pair).value * outward_normals(CURVE)[pair.node]
    line = nose_tail_chord(CURVE, *ENDS)
    along = (centres - line.nose_mm) @ line.along
    assert along.min() < place < along.max()
