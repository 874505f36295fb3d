"""Section measures against curves whose measures are known in closed form."""

import numpy as np
import pytest
from scipy.optimize import linprog

from simulators.sections import (
    centroid_mm,
    chord_ends_mm,
    chord_mm,
    compare,
    edge_radius_mm,
    max_thickness_mm,
    orientation_deg,
    signed_distance_mm,
    sizes,
)
from simulators.solids import Floats, loop_area_mm2


def ellipse(a: float, b: float, count: int = 4000) -> Floats:
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return np.column_stack([a * np.cos(angle), b * np.sin(angle)])


def wedge(left: float, right: float, length: float) -> Floats:
    """The outline of all circles between two: radius `left` at x = 0, `right` at x = length."""
    lean = np.arcsin((left - right) / length)
    nose = np.linspace(0.5 * np.pi - lean, 1.5 * np.pi + lean, 2000)
    tail = np.linspace(-0.5 * np.pi + lean, 0.5 * np.pi - lean, 2000)
    round_nose = left * np.column_stack([np.cos(nose), np.sin(nose)])
    round_tail = [length, 0.0] + right * np.column_stack([np.cos(tail), np.sin(tail)])
    share = np.linspace(0.0, 1.0, 2000)[1:-1, None]
    below = round_nose[-1] + share * (round_tail[0] - round_nose[-1])
    above = round_tail[-1] + share * (round_nose[0] - round_tail[-1])
    return np.vstack([round_nose, below, round_tail, above])


def turned(curve: Floats, angle_deg: float) -> Floats:
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return curve @ np.array([[c, s], [-s, c]])


def test_an_ellipse() -> None:
    curve = turned(ellipse(20.0, 2.5), 17.0) + np.array([3.0, -4.0])
    assert centroid_mm(curve) == pytest.approx([3.0, -4.0], abs=1e-12)
    assert chord_mm(curve) == pytest.approx(40.0, abs=1e-4)
    assert max_thickness_mm(curve) == pytest.approx(5.0, abs=1e-5)


def test_a_slice_with_long_sides_is_as_thick_as_its_polygon() -> None:
    """Where a corner lies opposite the middle of a long side."""
    wedge = np.array([[0.0, 0.0], [30.0, -1.5], [30.0, 1.5]])
    assert max_thickness_mm(wedge) == pytest.approx(2.0 * _inscribed_radius(wedge), abs=1e-4)
    coarse = np.array([[0.0, 0.0], [6.0, -1.0], [20.0, -1.2], [31.0, 0.0], [13.0, 1.3], [4.0, 0.9]])
    assert max_thickness_mm(coarse) == pytest.approx(_widest_circle(coarse), abs=1e-3)


def _inscribed_radius(triangle: Floats) -> float:
    """Twice the area over the perimeter."""
    around = np.linalg.norm(triangle - np.roll(triangle, 1, axis=0), axis=1).sum()
    return 2.0 * abs(loop_area_mm2(triangle)) / float(around)


def _widest_circle(polygon: Floats) -> float:
    """Of a convex polygon, by the linear programme that pushes its sides inward alike."""
    sides = np.roll(polygon, -1, axis=0) - polygon
    outward = np.column_stack([sides[:, 1], -sides[:, 0]]) / np.linalg.norm(sides, axis=1)[:, None]
    rows = np.column_stack([outward, np.ones(len(polygon))])
    best = linprog([0.0, 0.0, -1.0], A_ub=rows, b_ub=(outward * polygon).sum(axis=1), bounds=(None, None))
    return 2.0 * float(best.x[2])


def test_the_sizes_of_a_wedge() -> None:
    curve = wedge(2.5, 0.4, 40.0)
    found = sizes(curve, np.array([-2.0, 0.3]))
    assert found.chord_mm == pytest.approx(42.9, abs=1e-3)
    assert found.max_thickness_mm == pytest.approx(5.0, abs=1e-4)
    assert found.le_radius_mm == pytest.approx(2.5, abs=1e-3)
    assert found.te_radius_mm == pytest.approx(0.4, abs=0.02)  # the fit reaches past the round end


def test_an_edge_radius_within_the_round_end_is_exact() -> None:
    curve = wedge(2.5, 0.8, 40.0)
    ends = sorted(chord_ends_mm(curve), key=lambda end: float(end[0]))
    assert edge_radius_mm(curve, ends[1], 0.5) == pytest.approx(0.8, abs=1e-3)


@pytest.mark.parametrize("angle_deg", [-1.5, 0.03, 0.4])
def test_orientation_is_the_turn_about_the_centroid(angle_deg: float) -> None:
    curve = wedge(2.5, 0.4, 40.0)
    assert orientation_deg(curve, turned(curve, angle_deg) + np.array([5.0, 1.0])) == pytest.approx(
        angle_deg, abs=2e-4
    )


def test_distance_is_signed_outward() -> None:
    circle = ellipse(10.0, 10.0)
    points = np.array([[0.0, 10.2], [-9.7, 0.0], [7.0, 7.0]])
    assert signed_distance_mm(circle, points) == pytest.approx([0.2, -0.3, np.hypot(7, 7) - 10], abs=1e-5)


def test_a_shifted_and_thickened_wedge_is_compared() -> None:
    nominal, actual = wedge(2.5, 0.4, 40.0), wedge(2.6, 0.5, 40.0) + np.array([0.0, 0.3])
    le = np.array([-2.5, 0.0])
    truth = compare(1.0, nominal, sizes(nominal, le), actual, le)
    assert truth.position_y_mm == pytest.approx(0.3, abs=1e-9)
    assert 0.1 < truth.position_x_mm < 0.4  # the tail gains more than the nose
    assert truth.orientation_deg == pytest.approx(0.0, abs=1e-6)
    assert truth.profile_max_mm == pytest.approx(0.4, abs=1e-4)
    assert truth.profile_min_mm == pytest.approx(-0.2, abs=1e-3)
    assert truth.deviations()["max_thickness_mm"] == pytest.approx(0.2, abs=1e-4)
    assert truth.deviations()["chord_mm"] == pytest.approx(0.2, abs=1e-4)
    assert truth.deviations()["profile_mm"] == truth.profile_max_mm
