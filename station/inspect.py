"""One merged cloud, no devices: plan and scan in, verdict and files out."""

from __future__ import annotations

import os
import stat
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from station.clouds import Scan, read_scan
from station.document import Inputs
from station.gates import Gate, Gates
from station.measure import Clock, Progress, as_cloud, measure_cloud
from station.plans import read_plan
from station.recipe import Recipe, prepare_recipe
from station.refusal import BadRequest
from station.result import write_inspection
from station.verdict import Verdict, judge

MAX_SERIAL = 64

# Without a cell there is no calibration, no table and no mode: the scan is taken as it was given.
NO_CELL = Gates(
    calibration=Gate(holds=True),
    daily_check=Gate(holds=True),
    continuity=Gate(holds=True),
    mode=Gate(holds=True),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Inspection:
    """The verdict, and the document that lies in the folder."""

    verdict: Verdict
    result: dict[str, Any]


def inspect_scan(
    plan_path: Path, scan_path: Path, folder: Path, *, serial: str, clock: Clock, progress: Progress
) -> Inspection:
    """The inspection of one scan, once its files are in `folder`.

    Raises `BadPlan`, `BadScan` or `BadRequest`, and then has changed nothing and told no progress; at the end
    `BadRequest` where the disk does not take the files, of which it then leaves no parts.
    """
    begun_s = clock()
    check_serial(serial)
    check_folder(folder)
    plan = read_plan(plan_path)
    planned_s = clock()
    scan = read_scan(scan_path)
    read_s = clock()
    recipe = prepare_recipe(plan)
    prepared_s = clock()
    cloud = as_cloud(scan.points_mm, recipe.plan.measurement.sigma_mm)
    measurement = measure_cloud(cloud, recipe, clock, progress)
    verdict = judge(measurement, recipe.plan, NO_CELL)
    spent = {"read": read_s - planned_s, "nominal": prepared_s - read_s, "total": clock() - begun_s}
    measurement = replace(measurement, timing_s={**measurement.timing_s, **spent})
    progress("write")
    inputs = inputs_of(recipe, scan, scan_path.name, serial)
    try:
        result = write_inspection(folder, measurement, verdict, recipe.plan, inputs)
    except OSError as error:
        raise unwritten(folder, error) from error
    return Inspection(verdict=verdict, result=result)


def check_serial(serial: str) -> None:
    """Raise `BadRequest` for a serial number that cannot be shown. It never becomes part of a path."""
    if not (0 < len(serial) <= MAX_SERIAL and serial.isprintable()):
        raise BadRequest(f"serial {serial!r}: want 1 to {MAX_SERIAL} printable characters")


def check_folder(folder: Path) -> None:
    """Raise `BadRequest` unless `folder` is a directory to write into, or can become one."""
    try:
        there = next(path for path in (folder, *folder.absolute().parents) if os.path.lexists(path))
        is_folder, opened = stat.S_ISDIR(there.stat().st_mode), os.access(there, os.W_OK | os.X_OK)
        folder.exists()
    except OSError as error:
        raise unwritten(folder, error) from error
    if not is_folder:
        raise BadRequest(f"{folder}: {there} is not a directory")
    if not opened:
        raise BadRequest(f"{folder}: {there} cannot be written to")


def unwritten(folder: Path, error: OSError) -> BadRequest:
    return BadRequest(f"{error.filename or folder}: {error.strerror or error}")


def inputs_of(recipe: Recipe, scan: Scan, name: str, serial: str) -> Inputs:
    return Inputs(
        serial=serial,
        scan_sha256=scan.sha256,
        plan_sha256=recipe.plan_sha256,
        nominal_sha256=recipe.nominal_sha256,
        scan_name=name,
        dropped_points=scan.dropped,
    )
