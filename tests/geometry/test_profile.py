"""Charts, motions, gaps and reconstructed profiles, against closed forms and slow twins."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from geometry.errors import BadInput, CannotMeasure
from geometry.sections.chart import NODES, SectionSettings, broad_normals, outward_normals, unroll
from geometry.sections.motion import find_motion
from geometry.sections.profile import Gap, find_gaps, reconstruct
from tests.geometry.airfoils import AnalyticNominal, Blade, Part, scan_in_place

SETTINGS = SectionSettings()
NOMINAL = AnalyticNominal(Blade())
CHART = unroll(NOMINAL, 52.5, 6.0, SETTINGS)


def lagrange_weights(at, x):
    """Weights of values `at` three places in the parabola through them, at x."""
    others = [np.delete(at, i) for i in range(3)]
    return np.array([np.prod((x - other) / (a - other)) for a, other in zip(at, others, strict=True)])


def nearest_on_curve(points, curve):
    """Distance of points (n, 2) to a closed polyline, over all its segments."""
    a, b = curve, np.roll(curve, -1, axis=0)
    e = b - a
    f = np.einsum("nmk,mk->nm", points[:, None] - a, e) / (e * e).sum(axis=1)
    foot = a + np.clip(f, 0.0, 1.0)[:, :, None] * e
    return np.linalg.norm(points[:, None] - foot, axis=2).min(axis=1)


def test_chart_nodes_stand_on_the_nominal_between_its_edges():
    for layer in (0, CHART.here, -1):
        curve, le = NOMINAL.blade.section(float(CHART.z_mm[layer]))
        nodes = CHART.nodes_mm[layer]
        assert nearest_on_curve(nodes[::31], curve).max() < 1e-9
        assert_allclose(nodes[[0, NODES // 2]], curve[[0, le]], atol=1e-9)


def test_chart_is_dense_enough_at_the_edges():
    step = np.diff(CHART.arc_mm)
    assert step[0] < 0.02
    assert step[NODES // 2] < 0.02
    assert step.max() < 0.07


def test_a_plane_outside_the_airfoil_is_refused():
    with pytest.raises(BadInput, match="outside"):
        unroll(NOMINAL, 106.0, 6.0, SETTINGS)


def test_projection_equals_the_search_over_all_segments():
    rng = np.random.default_rng(0)
    z = rng.uniform(CHART.z_mm[0], CHART.z_mm[-1], 300)
    base = CHART.curve_mm[rng.integers(0, NODES, 300)]
    points = np.column_stack([base + rng.normal(0.0, 0.4, (300, 2)), z])
    found = CHART.project(points)
    for row, (point, height) in enumerate(zip(points, z, strict=True)):
        first = 0 if height < 52.5 else 2
        three = slice(first, first + 3)
        curve = np.einsum("k,kmc->mc", lagrange_weights(CHART.z_mm[three], height), CHART.nodes_mm[three])
        assert abs(found[row, 1]) == pytest.approx(nearest_on_curve(point[None, :2], curve)[0], abs=1e-9)


def test_projection_gives_back_offset_nodes_with_their_sign():
    nodes = np.arange(0, NODES, 7)
    normals = outward_normals(CHART.curve_mm)[nodes]
    for offset in (0.15, -0.15):
        place = CHART.curve_mm[nodes] + offset * normals
        found = CHART.project(np.column_stack([place, np.full(len(nodes), 52.5)]))
        assert_allclose(found[:, 1], offset, atol=4e-5)
        turn = (found[:, 0] - nodes + NODES / 2) % NODES - NODES / 2
        assert np.abs(turn).max() < 0.2


@pytest.mark.parametrize("inward_mm", [0.05, 0.15])
def test_what_is_drawn_inward_of_facets_does_not_fold(inward_mm):
    """An edge of 0.25 mm radius in 24 facets, ten nodes on each."""
    corner = 2.0 * np.pi * np.arange(25) / 24
    at = np.arange(240) / 10.0
    edge_mm = 0.25 * np.column_stack([np.interp(at, np.arange(25), f(corner)) for f in (np.cos, np.sin)])
    tangents = np.roll(edge_mm, -1, axis=0) - np.roll(edge_mm, 1, axis=0)

    def least_step(normals):
        drawn_mm = edge_mm - inward_mm * normals
        return ((np.roll(drawn_mm, -1, axis=0) - drawn_mm) * tangents).sum(axis=1).min()

    assert least_step(broad_normals(edge_mm)) > 0.0
    assert least_step(outward_normals(edge_mm)) < 0.0


def test_a_rigid_motion_is_found_among_outliers():
    rng = np.random.default_rng(1)
    part = Part(shift_mm=(0.4, -0.3), turn_deg=0.8)
    points = part.scan(rng, 46.5, 58.5, 0.5, 0.01)
    wild = rng.random(len(points)) < 0.1
    points[wild, :2] += rng.uniform(0.5, 3.0, (wild.sum(), 2))
    motion = find_motion(CHART, points)
    moved = part.section(52.5)
    assert nearest_on_curve(motion.do(CHART.curve_mm)[::17], moved).max() < 0.005


def test_undoing_a_motion_takes_the_moved_curve_back():
    part = Part(shift_mm=(0.4, -0.3), turn_deg=0.8)
    motion = find_motion(CHART, part.scan(np.random.default_rng(1), 46.5, 58.5, 0.5, 0.001))
    there = motion.do(CHART.curve_mm)
    back = motion.undo(np.column_stack([there, np.full(NODES, 52.5)]))
    assert_allclose(back[:, :2], CHART.curve_mm, atol=1e-12)


def test_a_noise_free_part_is_reconstructed_to_a_third_of_a_micrometre():
    part = Part(
        deviation=lambda s, z: 0.02 * np.sin(2 * np.pi * 6 * s + 0.03 * z),
        shift_mm=(0.05, 0.02),
        turn_deg=0.1,
    )
    points = part.scan(np.random.default_rng(2), 46.5, 58.5, 0.25, 0.0)
    profile = reconstruct(scan_in_place(points, 0.01), CHART, SETTINGS)
    assert nearest_on_curve(profile.curve_mm[::13], part.section(52.5)).max() < 3e-4
    assert profile.gaps == ()


def test_leftover_outliers_do_not_move_the_profile():
    rng = np.random.default_rng(3)
    part = Part(deviation=lambda s, z: 0.004 * np.sin(2 * np.pi * 6 * s) + 0.0 * z)
    points = part.scan(rng, 46.5, 58.5, 0.2, 0.015)
    wild = rng.random(len(points)) < 0.03
    points[wild, :2] += rng.uniform(0.1, 0.6, (wild.sum(), 1)) * np.array([0.3, 0.9])
    profile = reconstruct(scan_in_place(points, 0.01), CHART, SETTINGS)
    assert nearest_on_curve(profile.curve_mm[::13], part.section(52.5)).max() < 0.003


def test_erosion_of_the_leading_edge_is_followed():
    def eroded(s, z):
        """0.15 mm off the leading edge, within 2 mm of arc."""
        le = CHART.arc_mm[NODES // 2] / CHART.perimeter_mm
        return -0.15 * np.exp(-(((s - le) * CHART.perimeter_mm / 1.0) ** 2)) + 0.0 * z

    part = Part(deviation=eroded)
    points = part.scan(np.random.default_rng(4), 46.5, 58.5, 0.15, 0.015)
    profile = reconstruct(scan_in_place(points, 0.01), CHART, SETTINGS)
    assert nearest_on_curve(profile.curve_mm[::7], part.section(52.5)).max() < 0.004
    assert profile.deviation_mm.min() == pytest.approx(-0.15, abs=0.004)


def test_a_scan_without_noise_ends_at_the_strongest_smoothing():
    """Every strength is at the end of its range: there is no step to learn from."""
    notched = Part(deviation=lambda s, z: -0.15 * np.exp(-(((s - 0.5) * 180.0) ** 2)) + 0.0 * z)
    points = notched.scan(np.random.default_rng(4), 46.5, 58.5, 0.2, 0.0)
    with np.errstate(all="raise", under="ignore"):
        profile = reconstruct(scan_in_place(points, 0.01), CHART, SETTINGS)
    assert profile.noise_mm < 1e-4


def test_noise_is_found():
    points = Part().scan(np.random.default_rng(5), 46.5, 58.5, 0.2, 0.03)
    profile = reconstruct(scan_in_place(points, 0.01), CHART, SETTINGS)
    assert profile.noise_mm == pytest.approx(0.03 / np.sqrt(3.0), rel=0.07)


def test_a_missing_stretch_is_a_gap_of_its_width():
    part = Part()
    points = part.scan(np.random.default_rng(6), 46.5, 58.5, 0.15, 0.01)
    arc = CHART.arc_at(CHART.project(points)[:, 0])
    profile = reconstruct(scan_in_place(points[(arc < 20.0) | (arc > 25.0)], 0.01), CHART, SETTINGS)
    (gap,) = profile.gaps
    assert gap.start_mm == pytest.approx(20.0, abs=0.2)
    assert gap.width_mm == pytest.approx(5.0, abs=0.3)
    inside = profile.open_nodes()
    assert_allclose(CHART.arc_mm[:-1][inside][[0, -1]], [20.0, 25.0], atol=0.3)


def test_a_gap_may_run_over_the_trailing_edge():
    gaps = find_gaps(CHART, np.arange(2.0, CHART.perimeter_mm - 3.0, 0.5), 1.5)
    (gap,) = gaps
    assert gap.width_mm == pytest.approx(5.0, abs=0.5)
    assert gap.start_mm > CHART.perimeter_mm - 4.0


def test_no_points_are_one_gap():
    assert find_gaps(CHART, np.empty(0), 1.5) == (
        Gap(start_mm=0.0, width_mm=CHART.perimeter_mm, in_damage=False),
    )


def test_too_few_points_raise():
    points = Part().scan(np.random.default_rng(7), 46.5, 58.5, 0.2, 0.01)
    with pytest.raises(CannotMeasure):
        reconstruct(scan_in_place(points[:30], 0.01), CHART, SETTINGS)
    with pytest.raises(CannotMeasure):
        reconstruct(scan_in_place(points, 0.01, mask=np.ones(len(points), bool)), CHART, SETTINGS)


@settings(max_examples=60, deadline=None)
@given(
    arc=st.lists(st.floats(0.0, 88.0), min_size=2, max_size=60, unique=True),
    drop=st.integers(0, 59),
)
def test_dropping_a_point_never_closes_a_gap(arc, drop):
    def width(points):
        return sum(gap.width_mm for gap in find_gaps(CHART, np.array(points), 1.5))

    fewer = [a for i, a in enumerate(arc) if i != drop % len(arc)]
    assert width(fewer) >= width(arc) - 1e-9


@pytest.mark.parametrize("name", ["max_gap_mm", "band_mm", "knot_mm", "outlier"])
def test_settings_refuse_what_is_no_length(name):
    for value in (0.0, -1.0, float("nan")):
        with pytest.raises(BadInput):
            SectionSettings(**{name: value})
