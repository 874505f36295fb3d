"""A recorded job measured and judged again from its raw frames, by its own copies of plan and calibration."""

import hashlib
import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.errors import BadReply
from drivers.wire.scanner import decode_group
from geometry.errors import BadInput
from geometry.types import View
from station.config import read_calibration
from station.events import FindingRow
from station.filing import file_part
from station.gates import Gate, Gates
from station.job import finding_row
from station.journal import Frame, file_sha256
from station.measure import Views, absorb, conclude
from station.measurement import Measurement
from station.numbers import differences, numbers
from station.plans import BladePlan, read_plan
from station.proof import Decision
from station.recipe import Recipe, axis_of, prepare_recipe
from station.record import Ticket
from station.tomlfile import BadFile
from station.verdict import Verdict, judge

NOT_SCANNED = "not every view of the plan was captured: there is nothing to measure"


class BadJob(Exception):
    """A folder that is no whole job of this program; one line that names the file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedJob:
    """What a job folder holds. `decision` is None for a request that was interrupted before its verdict."""

    folder: Path
    ticket: Ticket
    frames: tuple[Frame, ...]
    inputs: dict[str, Path]
    measurement: Any
    decision: Decision | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayResult:
    """The verdict of the record and that of now, and each number or word in which they differ."""

    folder: Path
    serial: str
    recorded: str
    again: str
    differences: tuple[str, ...]

    @property
    def as_recorded(self) -> bool:
        return self.recorded == self.again and not self.differences


def replay_job(folder: Path, out: Path | None = None) -> ReplayResult:
    """The job measured and judged again; its files go to `out`. Raises `BadJob`."""
    job = read_job(folder)
    if job.decision is None:
        return result_of(job, "HOLD", ())
    try:
        plan = read_plan(job.inputs["plan"])
        if len(job.frames) != len(plan.scan.angles_deg):
            return result_of(job, "HOLD", ())
        recipe = prepare_recipe(plan, axis_of(read_calibration(job.inputs["calibration"])))
        measurement = measure_again(job, recipe)
    except (BadFile, BadInput, BadReply) as error:
        raise BadJob(f"{folder}: {error}") from error
    verdict = judge_again(job.decision, measurement, plan)
    if out is not None:
        try:
            file_part(recipe, measurement, folder / "frames.json", out, verdict, job.ticket)
        except OSError as error:
            raise BadJob(f"{error.filename or out}: {error.strerror or error}") from error
    return result_of(job, verdict.verdict.value, compared(job, job.decision, measurement, verdict))


def measure_again(job: RecordedJob, recipe: Recipe) -> Measurement:
    """The measurement of the recorded frames, folded in the order of the plan like live ones."""
    views = Views()
    for index, frame in enumerate(job.frames):
        points_mm = decode_group((job.folder / frame.file).read_bytes()).points_mm
        views = absorb(views, View(index=index, angle_deg=frame.angle_deg, points_mm=points_mm))
    return conclude(views, recipe, time.perf_counter, lambda step: None)


def judge_again(decision: Decision, measurement: Measurement, plan: BladePlan) -> Verdict:
    """The verdict with the gates of the cell as they were."""
    gates = {name: Gate(holds=held, reason="as recorded") for name, held in decision.gates.items()}
    return judge(measurement, plan, Gates(**gates))


def compared(
    job: RecordedJob, decision: Decision, measurement: Measurement, verdict: Verdict
) -> tuple[str, ...]:
    """Every difference in word, route, findings and measured numbers."""
    recorded = {"route": decision.route, "findings": [_row(row) for row in decision.findings]}
    again = {"route": verdict.route, "findings": [_row(finding_row(each)) for each in verdict.findings]}
    return (
        *differences(recorded, again),
        *differences(job.measurement, numbers(measurement), "measurement"),
    )


def _row(row: FindingRow) -> dict[str, Any]:
    return {name: getattr(row, name) for name in FindingRow.__slots__}


def result_of(job: RecordedJob, again: str, found: tuple[str, ...]) -> ReplayResult:
    """The result of a job."""
    return ReplayResult(
        folder=job.folder,
        serial=job.ticket.serial,
        recorded=job.decision.verdict if job.decision else "HOLD",
        again=again,
        differences=found,
    )


def read_job(folder: Path) -> RecordedJob:
    """The job in a folder, every frame and input against its digest; raises `BadJob`."""
    try:
        ticket = Ticket(**read_json(folder / "ticket.json"))
        frames = tuple(Frame(**row) for row in read_json(folder / "frames.json"))
        inputs = {role: folder / each["file"] for role, each in read_json(folder / "inputs.json").items()}
        digests = {role: each["sha256"] for role, each in read_json(folder / "inputs.json").items()}
        decided = (folder / "verdict.json").is_file()
        decision = Decision.from_body(read_json(folder / "verdict.json")) if decided else None
        measurement = read_json(folder / "measurement.json") if decided else None
        check_files(folder, frames, inputs, digests)
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise BadJob(f"{folder}: not a whole job: {error}") from error
    return RecordedJob(
        folder=folder,
        ticket=ticket,
        frames=frames,
        inputs=inputs,
        measurement=measurement,
        decision=decision,
    )


def check_files(
    folder: Path, frames: tuple[Frame, ...], inputs: dict[str, Path], digests: dict[str, str]
) -> None:
    """Raises `ValueError` for a frame or an input that is not the one that was recorded."""
    home = (folder / "inputs").resolve()
    for role, path in inputs.items():
        if home not in path.resolve().parents or file_sha256(path) != digests[role]:
            raise ValueError(f"{path} is not the {role} that was recorded")
    if missing := {"plan", "calibration"} - set(inputs):
        raise ValueError(f"inputs.json: no {' and no '.join(sorted(missing))}")
    for number, frame in enumerate(frames):
        if frame.file != f"frames/{number:03d}.gdp" or type(frame.angle_deg) not in (int, float):
            raise ValueError(f"frames.json: frame {number} is not one of this program")
        if not math.isfinite(frame.angle_deg):
            raise ValueError(f"frames.json: the angle of frame {number} is {frame.angle_deg}")
        content = (folder / frame.file).read_bytes()
        if hashlib.sha256(content).hexdigest() != frame.sha256 or len(content) != frame.bytes:
            raise ValueError(f"{frame.file} is not the frame that was recorded")


def read_json(path: Path) -> Any:
    """The document in a file."""
    return json.loads(path.read_bytes())
