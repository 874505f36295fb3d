"""`bladecell demo`: a simulated cell as a subprocess, and the station that runs on any shop floor.

The simulators are another program on the wire; the station reads the configuration that they write. With
a terminal the operator screen opens on the running station; without one a fixed number of parts is
inspected and every verdict is held against the truth that the simulator wrote when it loaded the part.
"""

import asyncio
import json
import select
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from station.console import line_of
from station.events import Event, VerdictAcknowledged, VerdictReached, printable

Process = subprocess.Popen[bytes]

PARTS = 3
SIMULATORS_S = 180.0
PART_S = 300.0
START_S = 300.0
END_S = 15.0


class DemoFailed(Exception):
    """The demo could not be run; one line."""


@dataclass(slots=True)
class Score:
    """The verdicts that the PLC has taken, by serial."""

    wanted: int
    verdicts: dict[str, str] = field(default_factory=dict)
    answered: int = 0

    def hear(self, event: Event) -> None:
        """Counts verdicts and answers."""
        if isinstance(event, VerdictReached):
            self.verdicts[event.serial] = event.verdict
        self.answered += isinstance(event, VerdictAcknowledged)

    @property
    def done(self) -> bool:
        return self.answered >= self.wanted


def run_demo(*, headless: bool, parts: int | None, seed: int) -> int:
    """The exit status: 0 if every verdict agrees with the truth, or when the screen was left."""
    folder = Path(tempfile.mkdtemp(prefix="bladecell-demo-"))
    try:
        with simulators(folder, parts or (PARTS if headless else None), seed):
            if headless:
                return inspect_parts(folder, parts or PARTS)
            return watch_parts(folder)
    except DemoFailed as error:
        say(f"demo: {error}")
        return 1
    finally:
        if headless:
            shutil.rmtree(folder, ignore_errors=True)
        else:
            say(f"the record and the files of every part lie in {folder}")


def inspect_parts(folder: Path, parts: int) -> int:
    """Runs the station in this process until the PLC took `parts` verdicts; 0 if all are true."""
    score = Score(parts)
    asyncio.run(run_until_done(folder / "station.toml", score))
    truths = read_truths(folder / "truth.log")
    wrong = 0
    for serial, verdict in score.verdicts.items():
        truth = truths.get(serial, "unknown")
        wrong += verdict != truth
        say(f"{serial}  {verdict:<6}  truth {truth:<6}  {'agrees' if verdict == truth else 'DISAGREES'}")
    missing = parts - len(score.verdicts)
    if missing > 0:
        say(f"{missing} of {parts} parts have no verdict")
    return 1 if wrong or missing > 0 or score.answered < parts else 0


async def run_until_done(config: Path, score: Score) -> None:
    """The station until the score is full or its time is over."""
    import time

    from station.cell import open_cell
    from station.config import read_config
    from station.operate import run_forever
    from station.run import leave_on_signals
    from station.software import software_version

    def hear(event: Event) -> None:
        score.hear(event)
        if (line := line_of(event)) is not None:
            say(line)

    deadline_s = START_S + PART_S * score.wanted
    async with open_cell(
        read_config(config), headless=True, version=software_version(), clock=time.monotonic, on_event=hear
    ) as cell:
        leave_on_signals(cell)
        running = asyncio.create_task(run_forever(cell))
        with suppress(TimeoutError):
            async with asyncio.timeout(deadline_s):
                await cell.until(lambda: score.done or cell.leaving or running.done())
        cell.leave()
        await running


def watch_parts(folder: Path) -> int:
    """Opens the operator screen on a station that starts by itself; 0 when the screen was left."""
    config = folder / "station.toml"
    command = [sys.executable, "-P", "-m", "station", "run", "--headless", "--config", str(config)]
    return watch_station(command, config, folder)


def watch_station(command: list[str], config: Path, folder: Path) -> int:
    """Opens the operator screen on the station that `command` runs; its lines go to `folder`/station.log."""
    from station.config import read_config
    from station.tui.app import main

    events = read_config(config).events
    with (folder / "station.log").open("ab") as log, running_process(command, out=log, log=log):
        main(events.host, events.port)
    return 0


@contextmanager
def simulators(folder: Path, parts: int | None, seed: int) -> Iterator[None]:
    """The simulated cell, which has written its configuration and listens; ended with the block."""
    command = [sys.executable, "-P", "-m", "simulators", "serve", "--preset", "demo", "--json"]
    command += ["--seed", str(seed), "--write-config", str(folder / "station.toml")]
    command += ["--truth-log", str(folder / "truth.log"), "--plc-log", str(folder / "plc.log")]
    command += ["--parts", str(parts)] if parts is not None else []
    with (
        (folder / "simulators.log").open("wb") as log,
        running_process(command, out=subprocess.PIPE, log=log) as process,
    ):
        say("the simulated cell starts")
        wait_for_addresses(process, folder / "simulators.log")
        yield


def wait_for_addresses(process: Process, log: Path) -> None:
    """Returns when the simulators have printed their addresses; raises `DemoFailed`."""
    assert process.stdout is not None
    if not select.select([process.stdout], [], [], SIMULATORS_S)[0]:
        raise DemoFailed(f"the simulated cell does not listen after {SIMULATORS_S:g} s")
    line = process.stdout.readline()
    try:
        json.loads(line)
    except ValueError:
        why = log.read_text(errors="replace").strip().splitlines()[-1:] or ["no reason given"]
        raise DemoFailed(f"the simulated cell did not start: {why[0]}") from None


@contextmanager
def running_process(command: list[str], *, out: int | IO[bytes], log: IO[bytes]) -> Iterator[Process]:
    """A process of ours, ended with the block: asked first, killed if it does not listen."""
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=out, stderr=log)  # noqa: S603
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if process.stdout is not None:
            process.stdout.close()


def read_truths(log: Path) -> dict[str, str]:
    """The true verdict of every part that the simulator loaded, by serial."""
    rows = (json.loads(line) for line in log.read_text().splitlines())
    return {row["serial"]: row["verdict"] for row in rows}


def say(line: str) -> None:
    """One line of progress, at once."""
    sys.stdout.write(f"{printable(line)}\n")
    sys.stdout.flush()
