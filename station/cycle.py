"""The procedure of one part: scan, measure, judge, record, release. A newcomer reads this file first.

Errors end in two places. Here, in `run_part`, what cannot be measured becomes HOLD. In operate.py a
failure of a device or of the store becomes a fault: the table stops, and nothing moves until a reset.
"""

import asyncio
from datetime import UTC, datetime

from drivers.errors import DriverError, LinkDown
from drivers.scanner import Scanner
from drivers.turntable import Turntable
from drivers.wire.scanner import RangeFrame
from station import alarms as engine
from station import handshake as shaking
from station.acquire import scan_part
from station.attend import recorded, tick
from station.cell import Cell, RecipeFile, utc_now
from station.daily import daily_gate
from station.events import StepFinished, StepStarted, VerdictReached
from station.filing import file_part, show_part
from station.gates import Gate, Gates
from station.handshake import Phase
from station.job import Job, add_frame, commit
from station.measurement import Measurement
from station.phases import Trigger
from station.publish import result_block
from station.reasons import alarm_number, ends_only_the_part
from station.record import CommittedVerdict
from station.verdict import Verdict, judge
from station.worker import WorkerFailed

ABSORB_S = 30.0
FILING_S = 60.0
LOAD_DEG = 0.0

_WORST_FIRST = ("SCRAP", "REPAIR", "HOLD", "PASS", "NOT_JUDGED")


class PartInterrupted(Exception):
    """The continuity of the part broke before its verdict could be shown."""


async def run_part(cell: Cell, recipe: RecipeFile, job: Job) -> None:
    """Scan, measure, judge, record and release one blade. What fails on the way ends as HOLD."""
    steps, failure = Steps(cell), None
    try:
        measurement = await measure_part(cell, recipe, job, steps)
    except (DriverError, WorkerFailed) as error:
        measurement, failure = Measurement(points=0, failures={"scan": str(error)}), error
        await cell.stop_motion()
    steps.begin("judge")
    gates = check_gates(cell, recipe, job)
    verdict = judge(measurement, recipe.plan, gates)
    steps.begin("record")
    alarm = None if failure is None else alarm_number(failure)
    committed = await cell.on_disk(
        commit, cell.record, job, measurement, recipe.plan, verdict, gates, alarm, datetime.now(UTC)
    )
    release(cell, committed, steps.end())
    await cell.on_disk(cell.record.published, job.record_no, utc_now())
    if failure is None:
        await show_and_file(cell, job, verdict)
    elif not ends_only_the_part(failure):
        raise failure


async def measure_part(cell: Cell, recipe: RecipeFile, job: Job, steps: "Steps") -> Measurement:
    """The measurement of the part on the table; it turns back to where it is unloaded meanwhile."""
    turntable, scanner = in_place(cell)

    async def keep(frame: RangeFrame, rest_deg: float) -> None:
        await cell.on_disk(add_frame, job, frame.raw, rest_deg, frame.frame_index)

    steps.begin("scan")
    await cell.worker.begin(recipe.number, ABSORB_S)
    async for view in scan_part(turntable, scanner, cell.scan_plan(recipe), keep, cell.emit):
        await cell.worker.absorb(view, ABSORB_S)
    parked = asyncio.ensure_future(turntable.move_to(LOAD_DEG))
    try:
        measurement = await cell.worker.conclude(cell.config.worker.timeout_s, steps.begin)
        await parked
    finally:
        parked.cancel()
    return measurement


def release(cell: Cell, committed: CommittedVerdict, durations_s: dict[str, float]) -> None:
    """Shows the verdict to the PLC, unless the part was touched since: one step, nothing in between."""
    tick(cell)
    if cell.shake.phase is not Phase.MEASURING:
        raise PartInterrupted
    publish(cell, committed)
    tell_verdict(cell, committed, durations_s)


def publish(cell: Cell, committed: CommittedVerdict) -> None:
    """Puts a committed verdict into the registers, now or again after a restart."""
    ticket, now_s, block = committed.ticket, cell.clock(), result_block(committed)
    cell.shake = shaking.published(cell.shake, ticket.sequence, ticket.serial, now_s)
    bits = shaking.status(cell.shake, cell.plc.request(), cell.health(now_s))
    cell.plc.publish(block, bits)
    cell.fire(Trigger.PUBLISHED)
    cell.moved.set()


def tell_verdict(cell: Cell, committed: CommittedVerdict, durations_s: dict[str, float]) -> None:
    """Shows the verdict to the operator, with the alarm of a HOLD."""
    ticket, decision = committed.ticket, committed.decision
    worst_first = sorted(decision.findings, key=lambda row: _WORST_FIRST.index(row.outcome))
    cell.emit(
        VerdictReached(
            serial=ticket.serial,
            sequence=ticket.sequence,
            part_number=ticket.part_number,
            verdict=decision.verdict,
            route=decision.route,
            reasons=decision.reasons,
            findings=tuple(worst_first),
            record_no=committed.record_no,
            durations_s=durations_s,
            simulated=ticket.simulated,
            at_utc=decision.decided_utc,
        )
    )
    cell.emit(recorded(cell.record.request(committed.record_no)))
    if decision.verdict == "HOLD" and decision.reason_no in engine.KINDS:
        cell.alarm(decision.reason_no, f"{ticket.serial}: {decision.reasons[0]}", lasting=False)


async def show_and_file(cell: Cell, job: Job, verdict: Verdict) -> None:
    """Draws the part and writes its files; a verdict stands whether or not this succeeds."""
    try:
        for event in await cell.worker.perform(show_part, timeout_s=FILING_S):
            cell.emit(event)
        await cell.worker.perform(
            file_part, job.folder / "frames.json", job.folder, verdict, job.ticket, timeout_s=FILING_S
        )
        await cell.on_disk(cell.record.filed, job.record_no, utc_now())
    except WorkerFailed as error:
        cell.log("error", f"record {job.record_no}: its files could not be written: {error}")


def check_gates(cell: Cell, recipe: RecipeFile, job: Job) -> Gates:
    """What holds of the cell at the moment of judging."""
    changed = [role for role, digest in recipe.digests.items() if job.digests.get(role) != digest]
    left_days = cell.calibration_left_days()
    right_scanner = cell.calibration.scanner_serial == cell.config.scanner.serial
    return Gates(
        calibration=Gate(holds=left_days >= 0.0 and right_scanner, reason="expired, or of another scanner"),
        daily_check=daily_gate(cell.config, datetime.now(UTC)),
        continuity=Gate(holds=not changed, reason=f"changed since the start: {', '.join(changed)}"),
        mode=Gate(holds=cell.working, reason=f"mode {cell.config.mode} gives no verdicts"),
    )


def in_place(cell: Cell) -> tuple[Turntable, Scanner]:
    """The two devices; raises `LinkDown` when they are not connected."""
    if cell.turntable is None or cell.scanner is None:
        raise LinkDown("turntable", cell.config.turntable.port, "not connected")
    return cell.turntable, cell.scanner


class Steps:
    """Tells the screens where a part stands and keeps how long each step took."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell
        self._step: str | None = None
        self._since_s = cell.clock()
        self._durations_s: dict[str, float] = {}

    def begin(self, step: str) -> None:
        """Ends the step before and begins this one."""
        self.end()
        self._step, self._since_s = step, self._cell.clock()
        self._cell.emit(StepStarted(step=step))

    def end(self) -> dict[str, float]:
        """The seconds of every step so far."""
        if self._step is not None:
            took_s = self._cell.clock() - self._since_s
            self._durations_s[self._step] = took_s
            self._cell.emit(StepFinished(step=self._step, duration_s=took_s))
            self._step = None
        return dict(self._durations_s)
