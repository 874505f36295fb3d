"""Is everything here that a station needs? One line a check, and what to do about each that fails."""

from __future__ import annotations

import ctypes
import importlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path

from station.config import StationConfig, find_config, read_calibration, read_config
from station.daily import daily_gate
from station.plans import read_plan
from station.recipe import axis_of, prepare_recipe

LIBRARIES = ("numpy", "scipy", "numba", "trimesh", "manifold3d", "skimage", "pymodbus", "serial", "textual")
SYSTEM_LIBRARIES = {  # what the Open3D wheel links, with the Debian package that brings it
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libX11.so.6": "libx11-6",
    "libudev.so.1": "libudev1",
    "libgomp.so.1": "libgomp1",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One thing that was looked at; `fault` is None when it is as it should be."""

    what: str
    fault: str | None


def examine(config: Path | None, plan: Path | None, now: datetime) -> Iterator[Check]:
    """All checks, in the order in which they would stop a station. A check that fails ends none after it."""
    yield from examine_libraries()
    if plan is not None:
        yield tried(f"plan {plan}", lambda: prepare_recipe(read_plan(plan)))
    else:
        yield from examine_config(config, now)


def examine_libraries() -> Iterator[Check]:
    """The Python version, the packages, and the system libraries that a wheel cannot bring."""
    version = ".".join(map(str, sys.version_info[:3]))
    yield Check(what=f"Python {version}", fault=None if sys.version_info >= (3, 11) else "want 3.11 or newer")
    for name in LIBRARIES:
        yield tried(f"package {name}", partial(importlib.import_module, name))
    for name, package in SYSTEM_LIBRARIES.items() if sys.platform == "linux" else ():
        check = tried(f"library {name}", partial(ctypes.CDLL, name))
        yield replace(check, fault=check.fault and f"missing: apt install {package}")


def examine_config(given: Path | None, now: datetime) -> Iterator[Check]:
    """The configuration and every file that it names."""
    found = tried("configuration", lambda: read_config(find_config(given)))
    yield found
    if found.fault is not None:
        return
    config = read_config(find_config(given))
    yield tried(f"calibration {config.calibration_path}", partial(check_calibration, config, now))
    yield tried("daily check", partial(check_daily, config, now))
    for number in config.recipes:
        yield tried(f"recipe {number}", partial(check_recipe, config, int(number)))
    yield tried(f"record {config.record_directory}", partial(check_writable, config.record_directory))


def check_calibration(config: StationConfig, now: datetime) -> None:
    """Raise what is wrong with the calibration: unreadable, no motion, of another scanner, out of date."""
    calibration = read_calibration(config.calibration_path)
    axis_of(calibration)
    age_days = calibration.age_days(now)
    if not 0.0 <= age_days <= config.calibration.max_age_days:
        raise ValueError(f"{age_days:.1f} days old, want 0 to {config.calibration.max_age_days:g}")
    if calibration.scanner_serial != config.scanner.serial:
        raise ValueError(f"is of scanner {calibration.scanner_serial}, not of {config.scanner.serial}")


def check_daily(config: StationConfig, now: datetime) -> None:
    """Raise why the daily check does not hold."""
    gate = daily_gate(config, now)
    if not gate.holds:
        raise ValueError(gate.reason)


def check_recipe(config: StationConfig, number: int) -> None:
    """Raise what is wrong with the plan or nominal of a recipe."""
    path = config.plan_path(number)
    assert path is not None
    prepare_recipe(read_plan(path))


def check_writable(folder: Path) -> None:
    """Raise `OSError` unless files can be made in `folder` or where it will be made."""
    there = next(path for path in (folder, *folder.parents) if path.exists())
    probe = there / ".bladecell-doctor"
    probe.touch(exist_ok=False)
    probe.unlink()


def tried(what: str, check: Callable[[], object]) -> Check:
    """The check of something that raises when it is not as it should be."""
    try:
        check()
    except Exception as error:
        line = " ".join(str(error).split()) or type(error).__name__
        return Check(what=what, fault=line)
    return Check(what=what, fault=None)
