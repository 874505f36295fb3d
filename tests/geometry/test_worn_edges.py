"""Edges that lost more than their rounding is wide: the nominal follows them, and so does the profile."""

import numpy as np
import pytest

from geometry.sections.chart import NODES, SectionSettings, unroll
from geometry.sections.motion import find_motion
from geometry.sections.profile import reconstruct
from geometry.sections.worn_edges import EDGES, with_worn_edges
from tests.geometry.airfoils import AnalyticNominal, Blade, Part, scan_in_place

SETTINGS = SectionSettings()
NOMINAL = AnalyticNominal(Blade())
CHART = unroll(NOMINAL, 52.5, SETTINGS.band_mm, SETTINGS)
NOISE_MM = 0.015
EDGE_OF = {EDGES[0]: lambda curve, le: curve[0], EDGES[1]: lambda curve, le: curve[le]}


def scanned(seed, spacing_mm=0.15):
    rng = np.random.default_rng(seed)
    return Part().scan(rng, 46.5, 58.5, spacing_mm, NOISE_MM)


def worn(points_mm, edge, back_mm):
    """Points (n, 3) within 2.5 mm of an edge carried inward, those at its end by `back_mm` (per point)."""
    here, other = (CHART.curve_mm[i] for i in (edge, (edge + NODES // 2) % NODES))
    inward = (other - here) / np.linalg.norm(other - here)
    behind_mm = (points_mm[:, :2] - path(edge, points_mm[:, 2])) @ inward
    carried_mm = back_mm * np.cos(0.5 * np.pi * np.clip(behind_mm / 2.5, 0.0, 1.0)) ** 2
    return points_mm + np.column_stack([carried_mm[:, None] * inward, np.zeros(len(points_mm))])


def path(edge, z_mm):
    """Where the edge of the nominal is (n, 2) at heights (n,)."""
    heights_mm = np.linspace(46.5, 58.5, 13)
    edges_mm = np.array([EDGE_OF[edge](*NOMINAL.blade.section(z)) for z in heights_mm.tolist()])
    return np.column_stack([np.interp(z_mm, heights_mm, axis_mm) for axis_mm in edges_mm.T])


def pushed(points_mm):
    return with_worn_edges(CHART, find_motion(CHART, points_mm), points_mm)


def test_a_chart_of_a_whole_blade_stays_as_it_is():
    assert pushed(scanned(1)) is CHART


@pytest.mark.parametrize(("edge", "back_mm"), [(EDGES[0], 0.6), (EDGES[1], 0.9), (EDGES[1], -0.3)])
def test_a_worn_edge_takes_the_chart_along(edge, back_mm):
    chart = pushed(worn(scanned(2), edge, back_mm))
    moved_mm = np.linalg.norm(chart.curve_mm - CHART.curve_mm, axis=1)
    assert moved_mm[edge] == pytest.approx(abs(back_mm), abs=0.15)
    assert moved_mm[(edge + NODES // 4) % NODES] == 0.0
    assert moved_mm[(edge + NODES // 2) % NODES] == 0.0


def test_a_push_may_grow_along_the_span():
    points_mm = scanned(3)
    chart = pushed(worn(points_mm, EDGES[0], 0.6 + 0.05 * (points_mm[:, 2] - 52.5)))
    moved_mm = np.linalg.norm(chart.nodes_mm - CHART.nodes_mm, axis=2)[:, EDGES[0]]
    assert moved_mm[-1] - moved_mm[0] == pytest.approx(0.3, abs=0.15)  # between the middles of both halves


def test_sides_without_their_edge_push_nothing():
    points_mm = scanned(4)
    apart_mm = np.linalg.norm(points_mm[:, :2] - path(EDGES[0], points_mm[:, 2]), axis=1)
    assert pushed(points_mm[apart_mm > 0.9]) is CHART


def test_an_edge_lost_elsewhere_pushes_nothing_here():
    points_mm = scanned(6)
    assert pushed(worn(points_mm, EDGES[1], np.where(points_mm[:, 2] < 50.5, 0.8, 0.0))) is CHART


def test_single_points_push_nothing():
    points_mm = scanned(5)
    rng = np.random.default_rng(5)
    strays_mm = points_mm[rng.integers(len(points_mm), size=40)] + rng.normal(scale=0.4, size=(40, 3))
    assert pushed(np.concatenate([points_mm, strays_mm])) is CHART


@pytest.mark.parametrize("edge", EDGES)
@pytest.mark.parametrize("back_mm", [-0.3, 0.3, 0.6])
def test_the_section_of_a_worn_edge_is_measured(edge, back_mm):
    """Its end has points all round, though none has its foot on the end of the nominal's."""
    chord_errors_mm = []
    for seed in range(3):
        points_mm = worn(scanned(10 + seed), edge, back_mm)
        profile = reconstruct(scan_in_place(points_mm, NOISE_MM), CHART, SETTINGS)
        assert profile.gaps == ()
        true_mm = worn(np.column_stack([CHART.curve_mm, np.full(NODES, 52.5)]), edge, back_mm)[:, :2]
        chord_errors_mm.append(
            np.ptp(profile.curve_mm @ chord_direction()) - np.ptp(true_mm @ chord_direction())
        )
    assert np.abs(chord_errors_mm).max() < 0.004


def chord_direction():
    chord_mm = CHART.curve_mm[EDGES[0]] - CHART.curve_mm[EDGES[1]]
    return chord_mm / np.linalg.norm(chord_mm)
