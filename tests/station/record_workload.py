"""A few requests written to a record, in a process that may be killed at any line: `DIR KILL_AT...`.

One folder for each number: the process forks, the child works and kills itself at that line of the
record's own code. `plc.log` is what a PLC would have latched, written only after the commit.
"""

import os
import signal
import sys
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Any

from station.events import FindingRow
from station.job import add_frame, begin_job, close_unjudged, recover
from station.journal import InputFile, digests
from station.proof import Decision, Figures
from station.record import Record, Ticket

WORDS = ("REPAIR", "HOLD", "PASS")
AT = "2026-01-01T00:00:00.000+00:00"
TRACED = ("record.py", "chain.py", "journal.py", "job.py")


def row(outcome: str) -> FindingRow:
    """A finding whose numbers carry its outcome."""
    value = {"PASS": 0.1, "REPAIR": 0.5, "SCRAP": 2.0, "HOLD": 0.2}[outcome]
    return FindingRow(
        characteristic="sections[7.0].chord_mm",
        value=45.0 + value,
        deviation=value,
        U=0.01,
        serviceable=0.2,
        repairable=1.0,
        outcome=outcome,
    )


def decision(word: Any, files: dict[str, str] | None = None, **fields: Any) -> Decision:
    """A decision that proves itself."""
    whole: dict[str, Any] = {
        "verdict": word,
        "route": "fill" if word == "REPAIR" else None,
        "reasons": ("chord",),
        "findings": (row(word),),
        "gates": {"calibration": True, "daily_check": True, "continuity": True, "mode": True},
        "evidence": {"alignment": True, "coverage": True, "damage": True, "steps": True},
        "reason_no": 0 if word == "PASS" else 404,
        "figures": Figures(worst_um=100, missing_mm3_x1000=5, defects=1, coverage_x100=9900),
        "files": files or {},
        "decided_ms": 1_767_225_600_000,
        "decided_utc": AT,
    }
    return Decision(**(whole | fields))


def ticket(sequence: int) -> Ticket:
    return Ticket(
        sequence=sequence,
        serial=f"SN-{sequence}",
        recipe=1,
        fixture=0,
        plc_epoch=1,
        part_number="HPC-R3",
        simulated=True,
        at_utc=AT,
    )


def work(directory: Path) -> None:
    """Recovers what an earlier run left, then serves the requests that are still missing."""
    record = Record.open(directory, station={"station_id": "T"}, at_utc=AT)
    _, standing = recover(record, datetime.now(UTC))
    if standing is not None:
        latch(directory, standing.ticket.sequence, standing.decision.verdict)
        record.acked(standing.record_no, 1, AT)
    for sequence, word in enumerate(WORDS, 1):
        if record.past(sequence) is None:
            serve(record, sequence, word)
    record.close()


def serve(record: Record, sequence: int, word: str) -> None:
    """One request from its acceptance to its acknowledgement."""
    record_no = record.accept(ticket(sequence))
    plan = InputFile(role="plan", source=Path(__file__), place="plan.toml")
    job = begin_job(record, record_no, ticket(sequence), (plan,), {})
    add_frame(job, bytes([sequence, 7]) * 50, 30.0, 1)
    if word == "HOLD":
        close_unjudged(record, record_no, 214, "stopped", datetime.now(UTC))
        return
    committed = record.decide(record_no, decision(word, digests(job.folder)))
    latch(record.directory, sequence, committed.decision.verdict)
    record.published(record_no, AT)
    record.acked(record_no, 1, AT)
    record.filed(record_no, AT)


def latch(directory: Path, sequence: int, word: str) -> None:
    """What the PLC believes from now on."""
    with (directory / "plc.log").open("a") as log:
        log.write(f"{sequence} {word}\n")
        log.flush()
        os.fsync(log.fileno())


def work_until(directory: Path, kill_at: int) -> int:
    """The number of lines of the record's code that ran; the process does not live past `kill_at`."""
    count = 0

    def local(frame: FrameType, event: str, _: Any) -> Any:
        nonlocal count
        if event == "line":
            count += 1
            if count == kill_at:
                os.kill(os.getpid(), signal.SIGKILL)
        return local

    def trace(frame: FrameType, event: str, argument: Any) -> Any:
        return local if Path(frame.f_code.co_filename).name in TRACED else None

    sys.settrace(trace)
    work(directory)
    sys.settrace(None)
    return count


def main(root: Path, kills: list[int]) -> None:
    for kill_at in kills:
        directory = root / str(kill_at)
        directory.mkdir()
        child = os.fork()
        if child == 0:
            count = work_until(directory, kill_at)
            (directory / "count").write_text(str(count))
            os._exit(0)
        os.waitpid(child, 0)


if __name__ == "__main__":
    main(Path(sys.argv[1]), [int(each) for each in sys.argv[2:]])
