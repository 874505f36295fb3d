"""From a request to its entries: what happens to one part on the disk thread, each a plain function."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from datetime import datetime
from pathlib import Path
from typing import Any

from station.events import FindingRow, VerdictWord
from station.findings import Finding
from station.gates import ACCEPTANCE, Gates, alignment_doubts
from station.journal import (
    Frame,
    InputFile,
    digests,
    job_folder,
    keep_frame,
    keep_inputs,
    keep_json,
    open_job,
)
from station.measurement import Measurement
from station.numbers import numbers
from station.plans import BladePlan
from station.proof import Decision, Figures
from station.publish import figures
from station.reasons import reason_number
from station.record import CommittedVerdict, Record, Request, Ticket
from station.verdict import Verdict, unseen


@dataclass(slots=True, kw_only=True)
class Job:
    """A part on its way through the cell."""

    record_no: int
    ticket: Ticket
    folder: Path
    frames: list[Frame] = field(default_factory=list)
    digests: Mapping[str, str] = field(default_factory=dict)


def begin_job(
    record: Record, record_no: int, ticket: Ticket, inputs: tuple[InputFile, ...], devices: Mapping[str, Any]
) -> Job:
    """The job of an accepted request, its folder open and its inputs copied."""
    folder = open_job(record.directory, record_no, asdict(ticket))
    kept = keep_inputs(folder, record.directory, inputs)
    keep_json(folder, "devices.json", devices)
    by_role = {role: each["sha256"] for role, each in kept.items()}
    return Job(record_no=record_no, ticket=ticket, folder=folder, digests=by_role)


def add_frame(job: Job, raw: bytes, angle_deg: float, frame_index: int) -> None:
    """Keeps one raw capture."""
    job.frames.append(keep_frame(job.folder, tuple(job.frames), raw, angle_deg, frame_index))


def commit(
    record: Record,
    job: Job,
    measurement: Measurement,
    plan: BladePlan,
    verdict: Verdict,
    gates: Gates,
    reason_no: int | None,
    now: datetime,
) -> CommittedVerdict:
    """The verdict in the record, with the digests of all files that it rests on.

    `reason_no` names the alarm of a failure that prevented the measurement."""
    keep_json(job.folder, "measurement.json", numbers(measurement))
    decision = decided(measurement, plan, verdict, gates, reason_no, {}, now)
    keep_json(job.folder, "verdict.json", asdict(decision))
    files = digests(job.folder)
    lost = [frame.file for frame in job.frames if files.get(frame.file) != frame.sha256]
    if lost:
        raise OSError(f"{job.folder / lost[0]} is not what the scanner sent")
    return record.decide(job.record_no, decided(measurement, plan, verdict, gates, reason_no, files, now))


def decided(
    measurement: Measurement,
    plan: BladePlan,
    verdict: Verdict,
    gates: Gates,
    reason_no: int | None,
    files: Mapping[str, str],
    now: datetime,
) -> Decision:
    """What the record keeps of a verdict."""
    word: VerdictWord = verdict.verdict.value
    return Decision(
        verdict=word,
        route=verdict.route,
        reasons=verdict.reasons,
        findings=tuple(finding_row(finding) for finding in verdict.findings),
        gates=gate_states(gates),
        evidence=evidence_of(measurement, plan),
        reason_no=reason_number(verdict, gates) if reason_no is None else reason_no,
        figures=figures(measurement, verdict),
        files=files,
        decided_ms=round(now.timestamp() * 1000.0),
        decided_utc=now.isoformat(timespec="milliseconds"),
    )


def finding_row(finding: Finding) -> FindingRow:
    """A finding as it is kept and shown."""
    return FindingRow(
        characteristic=finding.characteristic,
        value=finding.value,
        deviation=finding.deviation,
        U=finding.U,
        serviceable=finding.serviceable,
        repairable=finding.repairable,
        outcome=finding.outcome.value,
    )


def evidence_of(measurement: Measurement, plan: BladePlan) -> dict[str, bool]:
    """What besides its findings a verdict needs (`proof.EVIDENCE`)."""
    return {
        "alignment": not any(alignment_doubts(measurement, plan, ACCEPTANCE)),
        "coverage": not any(unseen(measurement, plan)),
        "damage": measurement.damages is not None,
        "steps": not measurement.failures,
    }


def gate_states(gates: Gates) -> dict[str, bool]:
    """Whether each gate of the cell holds."""
    return {each.name: getattr(gates, each.name).holds is True for each in fields(gates)}


def close_unjudged(record: Record, record_no: int, reason_no: int, why: str, now: datetime) -> None:
    """Closes an interrupted request: as HOLD, or if it was decided already, as never to be delivered."""
    at_utc = now.isoformat(timespec="milliseconds")
    if record.request(record_no).decision is not None:
        record.undelivered(record_no, why, at_utc)
        return
    decision = Decision(
        verdict="HOLD",
        route=None,
        reasons=(why,),
        findings=(),
        gates={"continuity": False},
        evidence={},
        reason_no=reason_no,
        figures=Figures(),
        files=digests(job_folder(record.directory, record_no)),
        decided_ms=round(now.timestamp() * 1000.0),
        decided_utc=at_utc,
        interrupted=True,
    )
    record.decide(record_no, decision)


def recover(record: Record, now: datetime) -> tuple[tuple[Request, ...], CommittedVerdict | None]:
    """The requests that an end of the station interrupted, now closed, and the verdict that still stands.

    A committed verdict that was not acknowledged is shown again as it was; nothing is measured again."""
    interrupted = tuple(request for request in record.requests() if request.decision is None)
    close_abandoned(record, "the station ended during the inspection", now, shown=True)
    standing = [request for request in record.requests() if request.stands]
    return interrupted, record.committed(standing[-1].record_no) if standing else None


def close_abandoned(record: Record, why: str, now: datetime, *, shown: bool) -> None:
    """Closes what was begun and never shown: no verdict of it may come back later.

    `shown`: that of the newest request stands in the registers, or is to be shown again."""
    requests = record.requests()
    for request in requests:
        newest = request is requests[-1]
        hidden = request.phase == "DECIDED" and request.stands and not (shown and newest)
        if hidden or request.decision is None:
            close_unjudged(record, request.record_no, 131, why, now)
