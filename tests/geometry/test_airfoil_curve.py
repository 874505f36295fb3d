"""What is measured on one curve, against closed forms: ellipses, and airfoils that are envelopes of discs."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from geometry.errors import CannotMeasure
from geometry.kernels.airfoil import closed_normals, closed_steps, farthest_pair, inscribed_circles
from geometry.sections.chart import NODES, SectionSettings, outward_normals, unroll
from geometry.sections.chords import chord
from geometry.sections.curve import (
    area,
    camber_line,
    centroid,
    centroid_gradient,
    edge,
    edge_radius,
    gauge,
    node_shares,
    orientation,
    thick_part,
    thickness,
)
from tests.geometry.airfoils import AnalyticNominal, Blade, DiscAirfoil, random_airfoil

A, B = 20.0, 4.0


def ellipse(turn_deg=0.0, shift=(0.0, 0.0)):
    """2048 nodes, node 0 at the end +A before the turn."""
    t = 2.0 * np.pi * np.arange(NODES) / NODES
    return turned(np.column_stack([A * np.cos(t), B * np.sin(t)]), turn_deg) + np.array(shift)


def turned(curve, turn_deg):
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    return curve @ np.array([[c, s], [-s, c]])


def nodes_of(airfoil, turn_deg=0.0):
    """The airfoil on corresponding nodes: trailing edge at 0, leading edge in the middle."""
    blade = Blade(airfoil=airfoil, twist_deg=0.0, taper=0.0)
    return turned(unroll(AnalyticNominal(blade), 50.0, 1.0, SectionSettings()).curve_mm, turn_deg)


STRAIGHT = DiscAirfoil(camber_mm=0.0)


def test_area_and_centroid_of_an_ellipse():
    curve = ellipse(30.0, (3.0, -2.0))
    assert area(curve) == pytest.approx(np.pi * A * B, rel=1e-5)
    assert_allclose(centroid(curve), [3.0, -2.0], atol=1e-12)


def test_shares_add_up_to_the_perimeter():
    assert node_shares(nodes_of(STRAIGHT)).sum() == pytest.approx(
        unroll(AnalyticNominal(Blade(airfoil=STRAIGHT)), 0.0, 1.0, SectionSettings()).perimeter_mm, rel=1e-12
    )


def bumped(curve, bump):
    return curve + outward_normals(curve) * bump[:, None]


def smooth_bumps():
    """Deviations as they occur: smooth along the arc."""
    t = 2.0 * np.pi * np.arange(NODES) / NODES
    return [1e-5 * np.cos(k * t + phase) for k, phase in ((1, 0.3), (3, 1.0), (8, 2.0))]


def growth(measure, curve, bump):
    return (measure(bumped(curve, bump)) - measure(bumped(curve, -bump))) / 2.0


@pytest.mark.parametrize("bump", smooth_bumps())
def test_gradients_foretell_what_small_deviations_do(bump):
    curve = nodes_of(DiscAirfoil(), 20.0)
    le, te, thick = edge(curve, NODES // 2), edge(curve, 0), thick_part(camber_line(curve, NODES // 2))
    assert_allclose(centroid_gradient(curve) @ bump, growth(centroid, curve, bump), atol=2e-9)
    nominal = curve.copy()
    for measure in (
        lambda c: orientation(c, nominal),
        lambda c: chord(c, le, te).line.length,
        lambda c: chord(c, le, te).stagger,
        lambda c: thickness(c, thick),
        lambda c: edge_radius(c, le.arc),
        lambda c: edge_radius(c, te.arc),
    ):
        expected = growth(lambda c, m=measure: m(c).value, curve, bump)
        assert measure(curve).gradient @ bump == pytest.approx(expected, rel=0.05, abs=3e-8)


@pytest.mark.parametrize("turn_deg", [-2.0, -0.1, 0.0, 0.05, 1.5])
def test_orientation_is_the_turn_counter_clockwise_whatever_the_shift(turn_deg):
    nominal = nodes_of(DiscAirfoil())
    measured = turned(nominal, turn_deg) + np.array([0.7, -0.4])
    assert np.rad2deg(orientation(measured, nominal).value) == pytest.approx(turn_deg, abs=1e-4)


@pytest.mark.parametrize("turn_deg", [0.0, 35.0, 120.0, -170.0])
def test_chord_and_stagger_of_a_straight_airfoil(turn_deg):
    curve = nodes_of(STRAIGHT, turn_deg)
    found = chord(curve, edge(curve, NODES // 2), edge(curve, 0))
    assert found.line.length.value == pytest.approx(44.0 + 0.8 + 0.45, abs=2e-5)
    assert np.rad2deg(found.stagger.value) == pytest.approx(turn_deg, abs=1e-4)


@pytest.mark.parametrize("camber_mm", [0.0, 2.0, 4.0])
def test_chord_is_the_largest_distance_of_any_two_points(camber_mm):
    curve = nodes_of(DiscAirfoil(camber_mm=camber_mm))
    every = np.arange(0, NODES)
    i, j = farthest_pair(curve, every, every)
    found = chord(curve, edge(curve, NODES // 2), edge(curve, 0))
    between_nodes_mm = 6e-5
    assert abs(found.line.length.value - np.linalg.norm(curve[i] - curve[j])) < between_nodes_mm


@pytest.mark.parametrize("camber_mm", [0.0, 4.0])
@pytest.mark.parametrize("largest_mm", [1.2, 2.6, 5.0])
def test_maximum_thickness_is_the_largest_disc(camber_mm, largest_mm):
    airfoil = DiscAirfoil(camber_mm=camber_mm, largest_mm=largest_mm)
    radius = airfoil.discs(np.linspace(0.0, 1.0, 20001))[1].max()
    curve = nodes_of(airfoil)
    found = thickness(curve, thick_part(camber_line(curve, NODES // 2)))
    assert found.value == pytest.approx(2.0 * radius, abs=2e-4)


@pytest.mark.parametrize(("le_mm", "te_mm"), [(0.8, 0.45), (0.3, 0.15), (1.2, 1.2)])
@pytest.mark.parametrize("camber_mm", [0.0, 4.0])
def test_edge_radii_are_those_of_the_end_discs(le_mm, te_mm, camber_mm):
    curve = nodes_of(DiscAirfoil(le_mm=le_mm, te_mm=te_mm, camber_mm=camber_mm))
    for tip, radius in ((NODES // 2, le_mm), (0, te_mm)):
        assert edge_radius(curve, edge(curve, tip).arc).value == pytest.approx(radius, rel=2e-3)


def test_an_edge_arc_spans_120_degrees():
    curve = nodes_of(DiscAirfoil())
    arc = edge(curve, NODES // 2).arc
    assert node_shares(curve)[arc].sum() == pytest.approx(np.deg2rad(120.0) * 0.8, rel=0.03)


def test_a_flat_edge_has_no_radius():
    line = np.column_stack([np.linspace(0.0, 1.0, 20), np.zeros(20)])
    with pytest.raises(CannotMeasure):
        edge_radius(line, np.arange(2, 18))


def test_inscribed_circles_equal_their_slow_twin():
    curve = nodes_of(DiscAirfoil())
    normals = outward_normals(curve)
    at, against = np.arange(100, 900, 40), np.arange(1100, 1950)
    radius, contact = inscribed_circles(curve, normals, at, against)
    for n, i in enumerate(at):
        away = curve[against] - curve[i]
        depth = -(away @ normals[i])
        r = np.where(depth > 0.0, (away**2).sum(axis=1) / (2.0 * np.where(depth > 0.0, depth, 1.0)), np.inf)
        assert radius[n] == pytest.approx(r.min(), rel=1e-12)
        assert contact[n] == against[np.argmin(r)]


def test_normals_and_steps_equal_their_slow_twins():
    curve, _ = DiscAirfoil().curve(per_side=50, per_edge=20)
    along = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    expected = np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
    assert_allclose(closed_normals(curve), expected, atol=1e-14)
    steps = np.linalg.norm(np.roll(curve, -1, axis=0) - curve, axis=1)
    assert_allclose(closed_steps(curve), steps, atol=1e-14)


def test_farthest_pair_equals_its_slow_twin():
    points = np.random.default_rng(0).normal(size=(40, 2))
    first, second = np.arange(0, 15), np.arange(20, 40)
    distance = np.linalg.norm(points[first][:, None] - points[second], axis=2)
    i, j = np.unravel_index(np.argmax(distance), distance.shape)
    assert farthest_pair(points, first, second) == (first[i], second[j])


@pytest.mark.parametrize("camber_mm", [0.0, 4.0])
def test_the_camber_line_goes_through_the_centres_of_the_discs(camber_mm):
    airfoil = DiscAirfoil(camber_mm=camber_mm)
    curve, le = airfoil.curve(per_side=3000)
    line = camber_line(curve, le)
    centre, radius, _ = airfoil.discs(np.linspace(0.0, 1.0, 40001))
    near = np.argmin(np.abs(line.centre_mm[:, :1] - centre[:, 0]), axis=1)
    assert_allclose(line.centre_mm, centre[near], atol=2e-3)
    assert_allclose(line.radius_mm, radius[near], atol=1e-3)
    assert (np.diff(line.centre_mm[:, 0]) > 0.0).all()


def test_thickness_at_a_gauge_is_that_of_the_disc_there():
    curve = nodes_of(STRAIGHT)
    nose = curve[NODES // 2]
    pair = gauge(camber_line(curve, NODES // 2), nose, np.array([1.0, 0.0]), 4.0)
    radius = STRAIGHT.discs(np.array([(4.0 - 0.8) / 44.0]))[1][0]
    assert thickness(curve, pair).value == pytest.approx(2.0 * radius, abs=0.02)


@pytest.mark.timeout(400)
def test_two_thousand_airfoils_are_measured_without_a_failure():
    """Chords of 10 to 100 mm, up to 25 % camber, edges from 0.3 % of the chord: values are the discs'."""
    rng = np.random.default_rng(0)
    measured = 0
    while measured < 2000:
        airfoil = random_airfoil(rng)
        if airfoil is None:
            continue
        curve, le = airfoil.curve(per_side=250, per_edge=124)
        curve = turned(curve, rng.uniform(-180.0, 180.0))
        largest = airfoil.discs(np.linspace(0.0, 1.0, 2001))[1].max()
        found = thickness(curve, thick_part(camber_line(curve, le)))
        assert found.value == pytest.approx(2.0 * largest, rel=2e-3)
        ends = edge(curve, le), edge(curve, 0)
        for end, radius in zip(ends, (airfoil.le_mm, airfoil.te_mm), strict=True):
            assert edge_radius(curve, end.arc).value == pytest.approx(radius, rel=0.01)
        assert chord(curve, *ends).line.length.value >= np.linalg.norm(curve[le] - curve[0]) - 1e-9
        measured += 1
