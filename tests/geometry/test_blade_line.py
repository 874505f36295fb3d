"""Lean, bow and relative twist of stacked sections, in closed form and by drawing."""

from dataclasses import replace

import numpy as np
import pytest

from geometry.errors import BadInput
from geometry.sections.airfoil import Section, SectionStatus, Stacking
from geometry.sections.blade_line import blade_line
from geometry.types import Measurand, NotMeasured
from tests.geometry import airfoils

HEIGHTS = (10.0, 40.0, 60.0, 90.0)


def alignment(information=None):
    return airfoils.alignment(information, pivot_z_mm=50.0)


def section(z, measured, nominal=(0.0, 0.0, 0.0), sd=(0.001, 0.001, 1e-5)):
    """A section at z with its centroid and turn; a twist of the pose moves the centroid by turn x arm."""
    arm = z - 50.0
    pose = np.zeros((3, 6))
    pose[0, 1], pose[1, 0], pose[2, 2] = arm, -arm, 1.0
    pose[0, 3] = pose[1, 4] = 1.0
    return Section(
        z_mm=z,
        status=SectionStatus.MEASURED,
        reason=None,
        covered_fraction=1.0,
        measurands={},
        nominals={},
        profile_mm=np.empty((0, 2)),
        deviation_mm=np.empty(0),
        run=np.empty(0, np.int64),
        stacking=Stacking(
            measured=np.array(measured),
            nominal=np.array(nominal),
            covariance=np.diag(np.square(sd)),
            pose=pose,
        ),
    )


def stack(x, y=None, turn=None):
    y, turn = (np.zeros(4) if each is None else each for each in (y, turn))
    return [section(z, (x[i], y[i], turn[i])) for i, z in enumerate(HEIGHTS)]


def test_a_leaning_blade_leans_and_has_no_bow():
    line = blade_line(stack(np.tan(np.deg2rad(2.0)) * np.array(HEIGHTS)), alignment())
    assert line.lean_x_deg.measured.value == pytest.approx(2.0)
    assert line.lean_y_deg.measured.value == pytest.approx(0.0)
    assert line.bow_mm.measured.value == pytest.approx(0.0, abs=1e-12)
    assert line.lean_x_deg.nominal == 0.0


def test_bow_is_the_largest_distance_from_the_line_of_the_ends():
    up = (np.array(HEIGHTS) - 10.0) / 80.0
    line = blade_line(stack(0.3 * 4.0 * up * (1.0 - up), 0.1 * up), alignment())
    assert line.bow_mm.measured.value == pytest.approx(0.3 * 4.0 * 0.625 * 0.375)


def test_relative_twist_goes_from_each_section_to_the_next():
    line = blade_line(stack(np.zeros(4), turn=np.deg2rad([0.1, 0.3, 0.2, 0.2])), alignment())
    assert [t.z_mm for t in line.relative_twist] == [(10.0, 40.0), (40.0, 60.0), (60.0, 90.0)]
    assert [t.twist_deg.measured.value for t in line.relative_twist] == pytest.approx([0.2, -0.1, 0.0])


def test_the_order_of_the_sections_does_not_matter():
    sections = stack(0.01 * np.array(HEIGHTS) ** 1.1)
    one, other = blade_line(sections, alignment()), blade_line(sections[::-1], alignment())
    assert one == other


def test_sigmas_are_those_of_drawn_sections_and_poses():
    rng = np.random.default_rng(0)
    sd = np.array([1e-4, 2e-4, 1e-4, 0.01, 0.01, 0.01])
    x, y = 0.02 * np.array([0.0, 3.0, 5.0, 1.0]), np.array([0.0, 0.1, 0.1, 0.0])
    base = stack(x, y)
    pose = alignment(np.diag(sd**-2.0))
    line = blade_line(base, pose)
    drawn = []
    for _ in range(400):
        twist = rng.normal(0.0, sd)
        moved = [
            replace(
                s,
                stacking=replace(
                    s.stacking,
                    measured=s.stacking.measured
                    + s.stacking.pose @ twist
                    + rng.normal(0.0, np.sqrt(np.diag(s.stacking.covariance))),
                ),
            )
            for s in base
        ]
        found = blade_line(moved, pose)
        drawn.append([found.lean_x_deg, found.lean_y_deg, found.bow_mm, found.relative_twist[1].twist_deg])
    spread = np.std([[each.measured.value for each in row] for row in drawn], axis=0)
    told = [
        line.lean_x_deg.measured.sigma,
        line.lean_y_deg.measured.sigma,
        line.bow_mm.measured.sigma,
        line.relative_twist[1].twist_deg.measured.sigma,
    ]
    assert spread == pytest.approx(told, rel=0.12)


def test_a_section_without_position_leaves_no_line_and_says_which():
    sections = stack(np.zeros(4))
    lost = NotMeasured(reason="a damage lies on the arc it needs", in_damage=True)
    sections[1] = replace(sections[1], stacking=None, measurands={"position_mm": lost})
    line = blade_line(sections, alignment())
    for judged in (line.lean_x_deg, line.bow_mm, line.relative_twist[0].twist_deg):
        assert isinstance(judged.measured, NotMeasured)
        assert judged.measured.in_damage
        assert "z = 40 mm" in judged.measured.reason
    assert isinstance(line.relative_twist[2].twist_deg.measured, Measurand)


@pytest.mark.parametrize("unseen", [1, 2])
def test_damage_excuses_no_line_that_an_unseen_section_lacks_as_well(unseen):
    sections = stack(np.zeros(4))
    for index in (1, 2):
        lost = NotMeasured(reason="no points", in_damage=index != unseen)
        sections[index] = replace(sections[index], stacking=None, measurands={"position_mm": lost})
    line = blade_line(sections, alignment())
    assert not line.bow_mm.measured.in_damage
    assert not line.relative_twist[1].twist_deg.measured.in_damage


def test_two_sections_have_a_lean_but_no_bow():
    line = blade_line(stack(np.zeros(4))[:2], alignment())
    assert isinstance(line.lean_x_deg.measured, Measurand)
    assert isinstance(line.bow_mm.measured, NotMeasured)


def test_one_section_has_no_line():
    line = blade_line(stack(np.zeros(4))[:1], alignment())
    assert isinstance(line.lean_x_deg.measured, NotMeasured)
    assert line.relative_twist == ()


def test_the_same_height_twice_is_refused():
    twice = stack(np.zeros(4))[:1] * 2
    with pytest.raises(BadInput, match="same height"):
        blade_line(twice, alignment())
