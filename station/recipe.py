"""A plan made ready to measure by: its nominal prepared once, its settings in the geometry's terms."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from geometry.blade.nominal import Nominal, NominalSettings, prepare_nominal
from geometry.blade.read import read_nominal
from geometry.coverage import CoverageSettings
from geometry.damage.damages import DamageSettings
from geometry.errors import BadInput
from geometry.registration.datums import DatumSettings
from geometry.repair.patches import RepairSettings
from geometry.scan.calibrate import AxisCalibration
from geometry.sections.airfoil import SectionSettings
from geometry.sections.chart import FitSettings
from geometry.types import Mesh
from station.config import Calibration
from station.formats.cad import is_cad, read_cad
from station.measurement import Outline
from station.plans import BadPlan, BladePlan, check_span

OFF_NOMINAL_MM = DatumSettings().off_nominal_mm


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recipe:
    """What is measured and how. `axis` is None where clouds come merged."""

    plan: BladePlan
    nominal: Nominal
    outlines: tuple[Outline, ...]
    axis: AxisCalibration | None
    nominal_sha256: str
    plan_sha256: str

    @property
    def section_settings(self) -> SectionSettings:
        wanted = self.plan.sections
        return SectionSettings(
            max_gap_mm=self.plan.coverage.max_gap_mm,
            tolerance_mm=wanted.tolerance_mm,
            edge_distances_mm=wanted.edge_distances_mm,
            fit=FitSettings(
                le=wanted.fit.le,
                suction=wanted.fit.suction,
                te=wanted.fit.te,
                pressure=wanted.fit.pressure,
                locked=frozenset(wanted.fit.locked),
            ),
        )

    @property
    def damage_settings(self) -> DamageSettings:
        return DamageSettings(max_gap_mm=self.plan.coverage.max_gap_mm)

    @property
    def repair_settings(self) -> RepairSettings:
        return RepairSettings(
            max_gap_mm=self.plan.coverage.max_gap_mm, allowance_mm=self.plan.repair.allowance_mm
        )

    @property
    def coverage_settings(self) -> CoverageSettings:
        wanted = self.plan.coverage
        return CoverageSettings(min_fraction=wanted.min_fraction, max_gap_mm=wanted.max_gap_mm)


def prepare_recipe(plan: BladePlan, axis: AxisCalibration | None = None) -> Recipe:
    """The recipe of a plan; raises `BadPlan` where the plan contradicts its nominal or what can be done."""
    plan_sha256, nominal_sha256 = (
        hashlib.sha256(path.read_bytes()).hexdigest() for path in (plan.path, plan.nominal_path)
    )
    try:
        mesh = _nominal_mesh(plan)
        check_span(plan, float(mesh.vertices_mm[:, 2].min()), float(mesh.vertices_mm[:, 2].max()))
        nominal = prepare_nominal(mesh, nominal_settings(plan))
        check_datum(plan, nominal)
        check_sections(plan, nominal)
        outlines = tuple(outline(nominal, z_mm) for z_mm in plan.sections.z_mm)
    except BadInput as error:
        raise BadPlan(plan.path, str(error), "nominal") from error
    return Recipe(
        plan=plan,
        nominal=nominal,
        outlines=outlines,
        axis=axis,
        nominal_sha256=nominal_sha256,
        plan_sha256=plan_sha256,
    )


def _nominal_mesh(plan: BladePlan) -> Mesh:
    """A mesh counts in the unit that the plan states; a CAD file states its own."""
    path = plan.nominal_path
    return read_cad(path) if is_cad(path) else read_nominal(path, plan.units)


def outline(nominal: Nominal, z_mm: float) -> Outline:
    """The nominal curve of a section with its two edges."""
    section = nominal.section(z_mm)
    return Outline(
        z_mm=z_mm,
        curve_mm=section.curve_mm,
        le_mm=section.curve_mm[section.le_index],
        te_mm=section.curve_mm[section.te_index],
    )


def nominal_settings(plan: BladePlan) -> NominalSettings:
    return NominalSettings(
        z_min_mm=plan.airfoil.z_min_mm,
        z_max_mm=plan.airfoil.z_max_mm,
        tip_mm=plan.zones.tip_mm,
        edge_mm=plan.zones.edge_mm,
    )


def check_sections(plan: BladePlan, nominal: Nominal) -> None:
    """Raise `BadPlan` unless the sections lie on the airfoil."""
    for z_mm in plan.sections.z_mm:
        if not nominal.z_min_mm <= z_mm <= nominal.z_max_mm:
            span = f"{nominal.z_min_mm:g} to {nominal.z_max_mm:g} mm"
            raise BadPlan(plan.path, f"{z_mm:g} mm is outside the airfoil, {span}", "sections.z_mm")


def check_datum(plan: BladePlan, nominal: Nominal) -> None:
    """Raise `BadPlan` unless the six datum points lie on the nominal."""
    points_mm = np.array(plan.alignment.points_mm or np.empty((0, 3)))
    for point, off_mm in zip(points_mm, nominal.closest(points_mm).distance_mm, strict=True):
        if not abs(off_mm) <= OFF_NOMINAL_MM:
            place = ", ".join(f"{x:g}" for x in point)
            raise BadPlan(
                plan.path, f"[{place}] is {abs(off_mm):.2f} mm off the nominal", "alignment.points_mm"
            )


def axis_of(calibration: Calibration) -> AxisCalibration:
    """The calibration file in the geometry's terms; raises `BadInput` for a matrix that is no motion."""
    return AxisCalibration(
        T_scanner_table0=np.array(calibration.T_scanner_table0),
        sigma_offset_mm=calibration.sigma_axis_offset_mm,
        sigma_tilt_deg=calibration.sigma_axis_tilt_deg,
    )
