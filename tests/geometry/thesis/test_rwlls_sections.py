"""Sections measured by the thesis' method: true within their sigmas, or not measured at all."""

from functools import cache

import numpy as np
import pytest

from geometry.sections.airfoil import SectionStatus, with_damages
from geometry.sections.chart import SectionSettings, unroll
from geometry.sections.measurands import define, form, place, shape
from geometry.thesis.rwlls_sections import ThesisSectionSettings, measure_sections_thesis
from geometry.transforms import exp
from geometry.types import Measurand, NotMeasured
from tests.geometry.airfoils import AnalyticNominal, Blade, Part, alignment, cloud_of, section_of

Z = 52.5
NOISE_MM, SPACING_MM = 0.015, 0.12
NOMINAL = AnalyticNominal(Blade())
PART = Part(
    deviation=lambda s, z: 0.01 * np.sin(2 * np.pi * 6 * s + 0.02 * z), shift_mm=(0.05, -0.03), turn_deg=0.2
)
CHART = unroll(NOMINAL, Z, 1.0, SectionSettings())


def scan(seed):
    return PART.scan(np.random.default_rng(seed), Z - 2.0, Z + 2.0, SPACING_MM, NOISE_MM)


def measure(points, mask=None, pose=None):
    cloud = cloud_of(points, NOISE_MM / np.sqrt(3.0))
    mask = np.zeros(len(points), bool) if mask is None else mask
    (section,) = measure_sections_thesis(cloud, mask, pose or alignment(), NOMINAL, [Z])
    return section


@cache
def one(seed=1):
    return measure(scan(seed))


class _Truth(AnalyticNominal):
    """The true part, unrolled on the same nodes as its nominal."""

    def section(self, z_mm):
        return section_of(PART.section(z_mm), self.blade.section(z_mm)[1], z_mm)


@cache
def truth():
    true = unroll(_Truth(PART.blade), Z, 0.5, SectionSettings()).curve_mm
    definition = define(CHART.curve_mm, CHART.side, SectionSettings())
    off = CHART.project(np.column_stack([true, np.full(len(true), Z)]))[:, 1]
    found = {
        **place(true, CHART.curve_mm),
        **shape(true, definition),
        **form(true, off, np.ones(len(true), bool), definition),
    }
    return {name: estimate.value for name, estimate in found.items()}


def test_values_are_true_within_their_sigmas():
    misses = {}
    for seed in range(1, 6):
        section = one(seed)
        assert section.status is SectionStatus.MEASURED
        assert section.reason is None
        for name, value in truth().items():
            found = section.measurands[name]
            if isinstance(found, Measurand) and found.sigma > 0.0:
                misses.setdefault(name, []).append((found.value - value) / found.sigma)
    assert {"position_mm", "orientation_deg", "chord_mm", "profile_max_mm", "le_radius_mm"} <= set(misses)
    for name, z in misses.items():
        assert np.abs(z).max() < 4.0, name
        assert np.sqrt(np.mean(np.square(z))) < 2.2, name


def test_sigmas_are_small_enough_to_judge_by():
    found = one().measurands
    assert found["position_x_mm"].sigma < 0.008
    assert found["orientation_deg"].sigma < 0.01
    assert found["ss_profile_max_mm"].sigma < 0.01
    assert found["chord_mm"].sigma < 0.03


def test_what_has_no_honest_sigma_is_not_measured():
    found = one().measurands["te_min_radius_mm"]
    assert isinstance(found, NotMeasured)
    assert not found.in_damage


def test_the_measured_profile_is_given_on_the_nominals_nodes():
    section = one()
    assert section.profile_mm.shape == CHART.curve_mm.shape
    assert section.covered_fraction == 1.0
    assert section.deviation_mm.max() == section.measurands["profile_max_mm"].value


def test_the_pose_is_undone_and_its_uncertainty_felt():
    T = exp(np.array([0.01, -0.02, 0.3, 5.0, -3.0, 2.0]), np.array([0.0, 0.0, 50.0]))
    moved = scan(1) @ np.linalg.inv(T)[:3, :3].T + np.linalg.inv(T)[:3, 3]
    information = np.diag([1e12, 1e12, 1e12, 0.01**-2, 1e12, 1e12])
    section, plain = measure(moved, pose=alignment(information, T)), one()
    for name in ("position_x_mm", "orientation_deg", "chord_mm"):
        assert section.measurands[name].value == pytest.approx(plain.measurands[name].value, abs=1e-5)
    sigma = plain.measurands["position_x_mm"].sigma
    assert section.measurands["position_x_mm"].sigma == pytest.approx(np.hypot(sigma, 0.01), rel=0.02)
    assert section.measurands["chord_mm"].sigma == pytest.approx(plain.measurands["chord_mm"].sigma, rel=0.02)


def arc_of_points(points):
    return CHART.arc_at(CHART.project(points)[:, 0])


def test_a_gap_leaves_nothing_measured():
    points = scan(2)
    section = measure(points[np.abs(arc_of_points(points) - 20.0) > 1.0])
    assert section.status is SectionStatus.NOT_COVERED
    assert section.covered_fraction == pytest.approx(1.0 - 2.0 / CHART.perimeter_mm, abs=0.01)
    assert all(isinstance(m, NotMeasured) and not m.in_damage for m in section.measurands.values())
    assert len(section.profile_mm) == 0


def test_a_gap_of_damage_is_the_damages():
    points = scan(2)
    section = measure(points, mask=np.abs(arc_of_points(points) - 20.0) < 1.5)
    assert section.status is SectionStatus.IN_DAMAGE
    assert all(isinstance(m, NotMeasured) and m.in_damage for m in section.measurands.values())


def test_a_little_damage_leaves_nothing_measured_until_it_is_known():
    points = scan(2)
    section = measure(points, mask=np.abs(arc_of_points(points) - 20.0) < 0.4)
    assert section.status is SectionStatus.NOT_COVERED
    assert with_damages(section, touched=True).status is SectionStatus.IN_DAMAGE


@pytest.mark.parametrize("count", [0, 40])
def test_too_few_points_are_said(count):
    section = measure(scan(3)[:count])
    assert section.status is SectionStatus.NOT_COVERED
    assert "no sound points" in section.reason


def test_sections_come_in_the_order_asked_for():
    cloud = cloud_of(scan(1), 0.01)
    sections = measure_sections_thesis(
        cloud, np.zeros(len(cloud), bool), alignment(), NOMINAL, [80.0, Z], ThesisSectionSettings()
    )
    assert [section.z_mm for section in sections] == [80.0, Z]
    assert [section.status for section in sections] == [SectionStatus.NOT_COVERED, SectionStatus.MEASURED]
