"""Desks that do no geometry, for tests of what goes on round the worker. Importable by a spawned process."""

import os
import signal
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from geometry.types import View
from station.measurement import Measurement
from station.worker import Progress


class CountingDesk:
    """Counts points; never measures anything that could be judged."""

    def __init__(self) -> None:
        self.points = 0
        self.begun: list[int] = []

    def begin(self, recipe: int) -> None:
        self.begun.append(recipe)
        self.points = 0

    def absorb(self, view: View) -> None:
        self.points += len(view.points_mm)

    def conclude(self, progress: Progress) -> Measurement:
        progress("register")
        return Measurement(points=self.points, failures={"register": "nothing was measured here"})

    def perform(self, task: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        return task(self, *arguments)


class SlowDesk(CountingDesk):
    """Takes for ever to conclude."""

    def conclude(self, progress: Progress) -> Measurement:
        progress("register")
        time.sleep(600.0)
        raise AssertionError


class CrashingDesk(CountingDesk):
    """Ends as a native library does that writes where it must not."""

    def conclude(self, progress: Progress) -> Measurement:
        os.kill(os.getpid(), signal.SIGSEGV)
        raise AssertionError


class FailingDesk(CountingDesk):
    """Raises."""

    def conclude(self, progress: Progress) -> Measurement:
        raise ValueError("a line\nand another")


def counting() -> CountingDesk:
    return CountingDesk()


def slow() -> CountingDesk:
    return SlowDesk()


def crashing() -> CountingDesk:
    return CrashingDesk()


def failing() -> CountingDesk:
    return FailingDesk()


def broken() -> CountingDesk:
    raise ValueError("no such nominal")


def begun(desk: CountingDesk) -> list[int]:
    return desk.begun


def inherited(desk: CountingDesk) -> list[str]:
    """What the open descriptors of the process are."""
    return [str(fd.readlink()) for fd in Path("/proc/self/fd").iterdir() if fd.is_symlink()]


def for_cell(plans: Mapping[int, Path], calibration: Path) -> CountingDesk:
    """As `station.cell.geometry_desk`, without geometry."""
    return CountingDesk()


def crashing_in_cell(plans: Mapping[int, Path], calibration: Path) -> CountingDesk:
    return CrashingDesk()


def slow_in_cell(plans: Mapping[int, Path], calibration: Path) -> CountingDesk:
    return SlowDesk()
