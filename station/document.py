"""The result document of one inspection. What was not measured is null, with its reason."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from geometry.registration.alignment import pose_covariance
from geometry.types import Measurand, Measured, NotMeasured
from station.software import software_commit, software_version

if TYPE_CHECKING:
    from geometry.coverage import ZoneCoverage
    from geometry.damage.damages import Damage
    from geometry.registration.alignment import Alignment
    from geometry.registration.datums import ServiceMotion
    from geometry.repair.patches import Patch
    from geometry.sections.airfoil import Section
    from geometry.sections.blade_line import BladeLine
    from station.findings import Finding
    from station.measurement import Measurement
    from station.plans import BladePlan
    from station.verdict import Verdict

SCHEMA = "bladecell.result/1"
STEPS = ("read", "clean", "register", "sections", "damage", "twin", "repair", "total")

Json = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Inputs:
    """What was measured and by which plan: SHA-256 of each file, and what else identifies the scan."""

    serial: str
    scan_sha256: str
    plan_sha256: str
    nominal_sha256: str
    scan_name: str
    dropped_points: int = 0
    at_utc: str | None = None
    simulated: bool = False


def document(measurement: Measurement, verdict: Verdict, plan: BladePlan, inputs: Inputs) -> Json:
    """The result document. What was not measured is null, with its reason under `not_measured`."""
    return {
        "schema": SCHEMA,
        "verdict": verdict.verdict.value,
        "route": verdict.route,
        "reasons": list(verdict.reasons),
        "part_number": plan.part_number,
        "revision": plan.revision,
        "serial": inputs.serial,
        "alignment": alignment_of(measurement.alignment),
        "merge_mm": measurement.merge_mm,
        "layered_fraction": measurement.layered_fraction,
        "service_motion": service_of(measurement.service),
        "sections": [section_of(section) for section in measurement.sections],
        "blade": blade_of(measurement.line),
        "form": values_of({"deviation_mm": measurement.form_mm}),
        "zones": [zone_of(zone) for zone in measurement.zones],
        "damages": [damage_of(damage) for damage in measurement.damages or ()],
        "detection": values_of(
            {zone.value: limit for zone, limit in measurement.detection_mm.items()}
            | {"area_mm2": measurement.detection_mm2}
        ),
        "repair": repair_of(measurement, verdict),
        "findings": [finding_of(finding) for finding in verdict.findings],
        "not_measured": dict(measurement.failures),
        "timing_s": {step: measurement.timing_s.get(step, 0.0) for step in STEPS}
        | dict(measurement.timing_s),
        "inputs": {
            "scan": inputs.scan_name,
            "scan_sha256": inputs.scan_sha256,
            "plan_sha256": inputs.plan_sha256,
            "nominal_sha256": inputs.nominal_sha256,
            "points": measurement.points,
            "dropped_points": inputs.dropped_points,
            "at_utc": inputs.at_utc,
            "simulated": inputs.simulated,
        },
        "software": {"version": software_version(), "commit": software_commit()},
    }


def number_of(measured: Measured) -> Json | None:
    """A measurand as the document has it; null without a number."""
    if isinstance(measured, Measurand):
        return {"value": measured.value, "sigma": measured.sigma, "unit": measured.unit}
    return None


def reasons_of(measured: Mapping[str, Measured]) -> dict[str, str]:
    return {name: m.reason for name, m in measured.items() if not isinstance(m, Measurand)}


def values_of(measured: Mapping[str, Measured]) -> Json:
    """Measurands by name, with the reasons for those that have no number."""
    return {name: number_of(m) for name, m in measured.items()} | {"not_measured": reasons_of(measured)}


def alignment_of(alignment: Alignment | None) -> Json | None:
    if alignment is None:
        return None
    sigma = np.sqrt(np.diag(pose_covariance(alignment)))
    return {
        "method": alignment.method,
        "T_nominal_scan": alignment.T_nominal_scan.tolist(),
        "pivot_mm": alignment.pivot_mm.tolist(),
        "information": alignment.information.tolist(),
        "form_covariance": alignment.form_covariance.tolist(),
        "unseen_covariance": alignment.unseen_covariance.tolist(),
        "sigma_deg": np.rad2deg(sigma[:3]).tolist(),
        "sigma_mm": sigma[3:].tolist(),
        "rms_mm": alignment.rms_mm,
        "noise_mm": alignment.noise_mm,
        "inlier_fraction": alignment.inlier_fraction,
        "explained_fraction": alignment.explained_fraction,
        "runner_up_ratio": finite(alignment.runner_up_ratio),
        "weak_directions": [list(direction) for direction in alignment.weak_directions],
        "iterations": alignment.iterations,
        "converged": alignment.converged,
    }


def service_of(service: ServiceMotion | NotMeasured | None) -> Json | None:
    """Bend and twist of the airfoil against its root; null where the plan names no datum zone."""
    match service:
        case None:
            return None
        case NotMeasured(reason=reason):
            return {"not_measured": {"service_motion": reason}}
    return values_of({field.name: getattr(service, field.name) for field in fields(service)})


def finite(value: float) -> float | None:
    """`value`, or null for the infinite ratio of a pose without any rival."""
    return value if np.isfinite(value) else None


def section_of(section: Section) -> Json:
    return {
        "z_mm": section.z_mm,
        "status": section.status.value,
        "reason": section.reason,
        "covered_fraction": section.covered_fraction,
        "band_mm": None if section.band_mm is None else list(section.band_mm),
        "band_points": section.band_points,
        "not_measured": reasons_of(section.measurands),
        "measurands": {name: number_of(m) for name, m in section.measurands.items()},
        "nominals": {name: float(value) for name, value in section.nominals.items() if np.isfinite(value)},
        "zones": {name: asdict(arc) for name, arc in section.zones.items()},
    }


def blade_of(line: BladeLine | None) -> Json | None:
    """What the sections say together, each number beside its nominal."""
    if line is None:
        return None
    judged = {"lean_x_deg": line.lean_x_deg, "lean_y_deg": line.lean_y_deg, "bow_mm": line.bow_mm}
    return {
        **values_of({name: each.measured for name, each in judged.items()}),
        "nominals": {name: each.nominal for name, each in judged.items() if each.nominal is not None},
        "relative_twist_deg": [
            {"z_mm": list(twist.z_mm), **values_of({"twist_deg": twist.twist_deg.measured})}
            for twist in line.relative_twist
        ],
    }


def zone_of(zone: ZoneCoverage) -> Json:
    return {
        "zone": zone.zone.value,
        "covered_fraction": zone.covered_fraction,
        "absent_fraction": zone.absent_fraction,
        "largest_gap_mm": zone.largest_gap_mm,
        "status": zone.status.value,
    }


def damage_of(damage: Damage) -> Json:
    sizes = {
        "depth_mm": damage.depth_mm,
        "area_mm2": damage.area_mm2,
        "volume_mm3": damage.volume_mm3,
        "remaining_chord_mm": damage.remaining_chord_mm,
        "above_root_mm": damage.above_root_mm,
        "spacing_mm": damage.spacing_mm,
        "off_nominal_mm": damage.off_nominal_mm,
    }
    return {
        "zone": damage.zone.value,
        "kind": damage.kind.value,
        "length_mm": damage.length_mm,
        "centroid_mm": damage.centroid_mm.tolist(),
        **values_of(sizes),
    }


def finding_of(finding: Finding) -> Json:
    return {
        "characteristic": finding.characteristic,
        "value": finding.value,
        "deviation": finding.deviation,
        "U": finding.U,
        "serviceable": finding.serviceable,
        "repairable": finding.repairable,
        "outcome": finding.outcome.value,
        "reason": finding.reason,
    }


def patches_of(measurement: Measurement, verdict: Verdict) -> list[Patch]:
    """The patches that the verdict asks to be put on, in order."""
    return [measurement.repairs.patches[i] for i in verdict.patches] if measurement.repairs else []


def repair_of(measurement: Measurement, verdict: Verdict) -> Json | None:
    """Total and patches; their uncertainties add, for the twin's error is common to all."""
    patches = patches_of(measurement, verdict)
    if not patches:
        return None
    volumes = [patch.volume_mm3 for patch in patches]
    return {
        "volume_mm3": {
            "value": sum(volume.value for volume in volumes),
            "sigma": sum(volume.sigma for volume in volumes),
            "unit": "mm3",
        },
        "patches": [patch_of(number, patch) for number, patch in enumerate(patches, 1)],
    }


def patch_of(number: int, patch: Patch) -> Json:
    return {
        "zone": patch.zone.value,
        "damage": patch.damage,
        "mesh": f"repair-{number}.stl",
        "watertight": patch.watertight,
        "volume_mm3": number_of(patch.volume_mm3),
        "volume_check_mm3": patch.volume_check_mm3,
        "allowance_mm": patch.allowance_mm,
        "written_mm3": number_of(patch.written_mm3),
        "broken_gap_mm": patch.broken_gap_mm,
        **values_of({"border_step_mm": patch.border_step_mm, "border_angle_deg": patch.border_angle_deg}),
    }


def document_text(result: Json) -> str:
    """The document as JSON; raises `ValueError` for a number that is not finite."""
    return json.dumps(result, allow_nan=False, indent=1, ensure_ascii=False) + "\n"
