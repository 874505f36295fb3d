"""The result of one inspection: its document, and the files of its folder.

Every file is complete under its name or absent. Earlier files of ours are replaced or removed only when the
new ones are ready, `result.json` last; what is not ours is never touched.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from geometry.transforms import apply, inverse
from geometry.types import Floats, Measurand, Measured, Mesh
from station.formats.threemf import threemf
from station.formats.write import ply_cloud, ply_mesh, stl
from station.report import render
from station.tables import sections_csv

if TYPE_CHECKING:
    from geometry.airfoil import Section
    from geometry.coverage import ZoneCoverage
    from geometry.damage import Damage
    from geometry.register import Alignment
    from geometry.repair import Patch
    from station.findings import Finding
    from station.measurement import Measurement
    from station.plans import BladePlan
    from station.verdict import Verdict

SCHEMA = "bladecell.result/1"
OURS = re.compile(
    r"(result\.json|report\.html|deviation\.ply|twin\.ply|repair(-([1-9][0-9]*|scan|fixture))?\.stl|repair\.3mf|sections\.csv)"
)
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
        "sections": [section_of(section) for section in measurement.sections],
        "form": values_of({"deviation_mm": measurement.form_mm}),
        "zones": [zone_of(zone) for zone in measurement.zones],
        "damages": [damage_of(damage) for damage in measurement.damages or ()],
        "detection": values_of({zone.value: limit for zone, limit in measurement.detection_mm.items()}),
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
    return {
        "method": alignment.method,
        "T_nominal_scan": alignment.T_nominal_scan.tolist(),
        "pivot_mm": alignment.pivot_mm.tolist(),
        "information": alignment.information.tolist(),
        "rms_mm": alignment.rms_mm,
        "noise_mm": alignment.noise_mm,
        "inlier_fraction": alignment.inlier_fraction,
        "explained_fraction": alignment.explained_fraction,
        "runner_up_ratio": finite(alignment.runner_up_ratio),
        "weak_directions": [list(direction) for direction in alignment.weak_directions],
        "iterations": alignment.iterations,
        "converged": alignment.converged,
    }


def finite(value: float) -> float | None:
    """`value`, or null for the infinite ratio of a pose without any rival."""
    return value if np.isfinite(value) else None


def section_of(section: Section) -> Json:
    return {
        "z_mm": section.z_mm,
        "status": section.status.value,
        "reason": section.reason,
        "covered_fraction": section.covered_fraction,
        "not_measured": reasons_of(section.measurands),
        "measurands": {name: number_of(m) for name, m in section.measurands.items()},
        "nominals": {name: float(value) for name, value in section.nominals.items() if np.isfinite(value)},
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
    sizes = {"depth_mm": damage.depth_mm, "area_mm2": damage.area_mm2, "volume_mm3": damage.volume_mm3}
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
        "broken_gap_mm": patch.broken_gap_mm,
        **values_of({"border_step_mm": patch.border_step_mm, "border_angle_deg": patch.border_angle_deg}),
    }


def software_version() -> str:
    try:
        return version("bladecell")
    except PackageNotFoundError:
        return "unknown"


@cache
def software_commit() -> str:
    """The commit of the checkout that this file runs from, or "unknown" for an installed package."""
    git = Path(__file__).resolve().parent.parent / ".git"
    try:
        head = (git / "HEAD").read_text(encoding="ascii").strip()
        name = head.removeprefix("ref: ")
        if name == head:
            return head
        loose = git / name
        if loose.is_file():
            return loose.read_text(encoding="ascii").strip()
        packed = (git / "packed-refs").read_text(encoding="ascii").splitlines()
        return next((line.split()[0] for line in packed if line.endswith(f" {name}")), "unknown")
    except (OSError, UnicodeDecodeError):
        return "unknown"


def document_text(result: Json) -> str:
    """The document as JSON; raises `ValueError` for a number that is not finite."""
    return json.dumps(result, allow_nan=False, indent=1, ensure_ascii=False) + "\n"


def write_inspection(
    folder: Path, measurement: Measurement, verdict: Verdict, plan: BladePlan, inputs: Inputs
) -> Json:
    """The result document, once it and all files that belong to it are in `folder`."""
    result = document(measurement, verdict, plan, inputs)
    files = {
        **surfaces(measurement),
        **repair_files(patches_of(measurement, verdict)),
        **framed_files(measurement, verdict, plan),
        "sections.csv": sections_csv(measurement, verdict).encode(),
        "report.html": render(result, measurement, verdict, plan).encode(),
        "result.json": document_text(result).encode(),
    }
    replace_files(folder, files)
    return result


def surfaces(measurement: Measurement) -> dict[str, bytes]:
    """The aligned scan with its deviations, and the twin, as far as there are such."""
    files = {}
    if len(measurement.aligned_mm):
        files["deviation.ply"] = ply_cloud(measurement.aligned_mm, measurement.deviation_mm)
    if measurement.twin_mesh is not None:
        files["twin.ply"] = ply_mesh(measurement.twin_mesh)
    return files


def repair_files(patches: list[Patch]) -> dict[str, bytes]:
    """Each patch as a file, and all of them as one of each format."""
    meshes: list[Mesh] = [patch.mesh for patch in patches]
    files = {f"repair-{number}.stl": stl([mesh]) for number, mesh in enumerate(meshes, 1)}
    if not meshes:
        return files
    named = {f"repair-{number} {patch.zone}": patch.mesh for number, patch in enumerate(patches, 1)}
    return files | {"repair.stl": stl(meshes), "repair.3mf": threemf(named)}


def framed_files(measurement: Measurement, verdict: Verdict, plan: BladePlan) -> dict[str, bytes]:
    """All patches in each further frame that the plan wants."""
    patches = patches_of(measurement, verdict)
    if not patches or measurement.alignment is None:
        return {}
    T_scan_nominal = inverse(measurement.alignment.T_nominal_scan)
    T_fixture_scan = np.eye(4) if plan.repair.T_fixture_scan is None else np.array(plan.repair.T_fixture_scan)
    frames = {"scan": T_scan_nominal, "fixture": T_fixture_scan @ T_scan_nominal}
    return {
        f"repair-{frame}.stl": stl([moved(patch.mesh, frames[frame]) for patch in patches])
        for frame in plan.repair.frames
    }


def moved(mesh: Mesh, T: Floats) -> Mesh:
    """The mesh in another frame."""
    return Mesh(vertices_mm=apply(T, mesh.vertices_mm), faces=mesh.faces)


def replace_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Puts `files` into `folder`, the last of them last, and removes what else of ours lies there.

    All are on disk under temporary names before the first takes its name."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        write_beside(folder / f".{name}.part", content)
    *others, last = files
    for name in others:
        (folder / f".{name}.part").replace(folder / name)
    for path in folder.iterdir():
        if OURS.fullmatch(path.name) and path.name not in files:
            path.unlink()
    (folder / f".{last}.part").replace(folder / last)
    sync(folder)


def write_beside(path: Path, content: bytes) -> None:
    """Writes a file that nobody else has, and waits until it is on disk."""
    path.unlink(missing_ok=True)
    with path.open("xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def sync(folder: Path) -> None:
    """Waits until the names in `folder` are on disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
