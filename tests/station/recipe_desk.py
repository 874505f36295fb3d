"""A desk whose recipe number says what it finds. The rest of the station is the real one."""

import os
import signal
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import parts

from geometry.types import NotMeasured, View, Zone
from station.measurement import Measurement
from station.worker import Progress

PASS, REPAIR, SCRAP, HOLD, CRASH, HANG, BUSY = range(1, 8)
FOUND: dict[int, dict[str, Any]] = {
    PASS: {},
    REPAIR: {"damages": (parts.damage(depth=8.0),), "repairs": parts.repairs(parts.patch())},
    SCRAP: {"damages": (parts.damage(zone=Zone.SURFACE, depth=6.0),)},
    HOLD: {"alignment": None, "form_mm": NotMeasured(reason="no pose"), "failures": {"register": "no pose"}},
    BUSY: {},
}


class RecipeDesk:
    """Takes views, then finds what its recipe says."""

    def __init__(self) -> None:
        self.recipe = 0
        self.views: list[View] = []

    def begin(self, recipe: int) -> None:
        self.recipe, self.views = recipe, []

    def absorb(self, view: View) -> None:
        self.views.append(view)

    def conclude(self, progress: Progress) -> Measurement:
        progress("register")
        if self.recipe == CRASH:
            os.kill(os.getpid(), signal.SIGSEGV)
        if self.recipe == HANG:
            time.sleep(600.0)
        if self.recipe == BUSY:
            time.sleep(0.5)
        points = sum(len(view.points_mm) for view in self.views)
        self.measurement = parts.measurement(**{**FOUND[self.recipe], "points": points})
        return self.measurement

    def perform(self, task: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        recipe = SimpleNamespace(plan=parts.plan(), plan_sha256="0" * 64, nominal_sha256="1" * 64)
        return task(recipe, self.measurement, *arguments)


def make(plans: Mapping[int, Path], calibration: Path) -> RecipeDesk:
    """As `station.cell.geometry_desk`, without geometry."""
    return RecipeDesk()
