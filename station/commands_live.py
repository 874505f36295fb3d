"""The commands that need a station, its record or its screen; each returns its exit status."""

import csv
import io
import json
import multiprocessing
import sqlite3
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from station.chain import FILE, RecordBroken
from station.config import StationConfig, find_config, read_config
from station.events import printable
from station.record import Request, read_requests
from station.record import verify as prove
from station.tomlfile import BadFile

EXIT = {"PASS": 0, "REPAIR": 10, "SCRAP": 20, "HOLD": 30}
FAILED, USAGE, DIFFERS = 1, 2, 3

FINDING_COLUMNS = ("characteristic", "value", "deviation", "U", "serviceable", "repairable", "outcome")
REQUEST_COLUMNS = (
    "record_no",
    "serial",
    "sequence",
    "part_number",
    "verdict",
    "route",
    "phase",
    "acknowledged",
    "decided_utc",
)


def run_station(*, config: Path | None, headless: bool) -> int:
    """`bladecell run`: with a terminal and an operator, the screen on a station of its own."""
    from station.console import print_line
    from station.run import run

    if headless or not on_terminal():
        return run(config, headless=headless, on_event=print_line)
    try:
        chosen = find_config(config)
        directory = read_config(chosen).record_directory
    except BadFile as error:
        return complain(str(error), USAGE)
    from station.demo import watch_station

    directory.mkdir(parents=True, exist_ok=True)
    return watch_station([sys.executable, "-P", "-m", "station.run", str(chosen)], chosen, directory)


def demo(*, headless: bool, parts: int | None, seed: int) -> int:
    """`bladecell demo`."""
    from station.demo import run_demo

    return run_demo(headless=headless or not on_terminal(), parts=parts, seed=seed)


def on_terminal() -> bool:
    """Whether there is somebody to look at a screen."""
    return sys.stdin.isatty() and sys.stdout.isatty()


def tui(*, connect: str | None, config: Path | None) -> int:
    """`bladecell tui`."""
    try:
        host, port = address(connect) if connect else events_address(config)
    except BadFile as error:
        return complain(str(error), USAGE)
    except ValueError:
        return complain(f"{connect}: want HOST:PORT", USAGE)
    from station.tui.app import main

    main(host, port)
    return 0


def address(text: str) -> tuple[str, int]:
    """Host and port; raises `ValueError`."""
    host, _, port = text.rpartition(":")
    return host or "127.0.0.1", int(port)


def events_address(config: Path | None) -> tuple[str, int]:
    """Where the station of a configuration tells its events."""
    events = settings(config).events
    return events.host, events.port


def settings(config: Path | None) -> StationConfig:
    """The configuration that is meant."""
    return read_config(find_config(config))


def replay(*, jobs: list[Path], out: Path | None, workers: int) -> int:
    """`bladecell replay`: of one job its verdict, of many whether all are as recorded."""
    from station.replay import BadJob, ReplayResult, replay_job

    outs = [None if out is None else out if len(jobs) == 1 else out / job.resolve().name for job in jobs]
    results: list[ReplayResult] = []
    try:
        if len(jobs) == 1 or workers == 1:
            for job, folder in zip(jobs, outs, strict=True):
                results.append(replay_job(job, folder))
                tell_replay(results[-1])
        else:
            with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
                for result in pool.map(replay_job, jobs, outs):
                    results.append(result)
                    tell_replay(result)
    except BadJob as error:
        return complain(str(error), USAGE)
    if len(results) == 1:
        return EXIT[results[0].again]
    return 0 if all(result.as_recorded for result in results) else DIFFERS


def tell_replay(result: Any) -> None:
    """One line for a job, and one for each difference."""
    word = "as recorded" if result.as_recorded else "DIFFERS"
    say(f"{result.folder.name}  {result.serial}  recorded {result.recorded}, now {result.again}: {word}")
    for each in result.differences:
        say(f"    {each}")


def history(*, config: Path | None, as_json: bool, last: int) -> int:
    """`bladecell history`."""
    try:
        requests = [row_of(request) for request in requests_of(config)[-last:]]
    except (BadFile, RecordBroken, sqlite3.Error) as error:
        return complain(str(error), USAGE if isinstance(error, BadFile) else FAILED)
    if as_json:
        sys.stdout.write(json.dumps(requests, allow_nan=False, indent=1) + "\n")
        return 0
    for row in requests:
        acked = "acknowledged" if row["acknowledged"] else "not acknowledged"
        when = row["decided_utc"] or row["accepted_utc"]
        head = f"{row['record_no']:>6}  {when}  {row['serial']:<32}  {row['verdict'] or 'none':<6}"
        say(f"{head}  {acked}  {row['reason'] or ''}")
    return 0


def requests_of(config: Path | None) -> tuple[Request, ...]:
    """Every request in the record of a configuration; none when there is no record yet."""
    directory = settings(config).record_directory
    return read_requests(directory) if (directory / FILE).exists() else ()


def row_of(request: Request) -> dict[str, Any]:
    """A request as `history --json` prints it."""
    ticket, decision = request.ticket, request.decision
    return {
        "record_no": request.record_no,
        "serial": ticket.serial,
        "sequence": ticket.sequence,
        "recipe": ticket.recipe,
        "part_number": ticket.part_number,
        "verdict": request.verdict,
        "route": decision.route if decision else None,
        "reason": decision.reasons[0] if decision and decision.reasons else None,
        "reason_no": decision.reason_no if decision else None,
        "interrupted": decision.interrupted if decision else True,
        "phase": request.phase,
        "acknowledged": request.ack_code is not None,
        "ack_code": request.ack_code,
        "released": request.released,
        "simulated": ticket.simulated,
        "accepted_utc": ticket.at_utc,
        "decided_utc": decision.decided_utc if decision else None,
        "acked_utc": request.acked_utc,
    }


def verify(*, config: Path | None) -> int:
    """`bladecell verify`: 0 if and only if the record proves itself."""
    try:
        problems = prove(settings(config).record_directory)
    except BadFile as error:
        return complain(str(error), USAGE)
    for problem in problems:
        say(problem)
    if not problems:
        say("the record proves itself: schema, chain, anchor, decisions, files")
    return FAILED if problems else 0


def export(*, config: Path | None, out: Path) -> int:
    """`bladecell export`: every finding of every request as CSV."""
    try:
        directory = settings(config).record_directory
        problems = prove(directory)
        if problems:
            return complain(f"nothing is exported from a record that does not hold: {problems[0]}", FAILED)
        text = findings_csv(read_requests(directory))
        out.write_text(text, encoding="utf-8")
    except BadFile as error:
        return complain(str(error), USAGE)
    except OSError as error:
        return complain(f"{out}: {error.strerror}", USAGE)
    return 0


def findings_csv(requests: tuple[Request, ...]) -> str:
    """One line for each finding, one for each request without any; formulas of spreadsheets made inert."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow((*REQUEST_COLUMNS, *FINDING_COLUMNS))
    for request in requests:
        row = row_of(request)
        head = [inert(row[name]) for name in REQUEST_COLUMNS]
        findings = request.decision.findings if request.decision else ()
        for finding in findings:
            writer.writerow([*head, *(inert(getattr(finding, name)) for name in FINDING_COLUMNS)])
        if not findings:
            writer.writerow([*head, *([""] * len(FINDING_COLUMNS))])
    return stream.getvalue()


def inert(value: object) -> object:
    """The value; text that a spreadsheet would run as a formula gets a quote before it."""
    return f"'{value}" if isinstance(value, str) and value[:1] in "=+-@" else value


def say(line: str) -> None:
    """One printable line on the standard output stream."""
    sys.stdout.write(f"{printable(line)}\n")


def complain(text: str, status: int) -> int:
    """The exit status, after one line on the standard error stream."""
    sys.stderr.write(f"bladecell: {printable(' '.join(text.split()))}\n")
    return status
