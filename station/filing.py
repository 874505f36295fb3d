"""Tasks for the worker, beside the measurement that it made last: draw it, write its files.

The station names these functions and the worker runs them; only there do their imports happen.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from station.journal import file_sha256

if TYPE_CHECKING:
    from station.events import CloudMeasured, SectionMeasured
    from station.measurement import Measurement
    from station.recipe import Recipe
    from station.record import Ticket
    from station.verdict import Verdict


def show_part(recipe: Recipe, measurement: Measurement) -> tuple[CloudMeasured | SectionMeasured, ...]:
    """The events that draw the part."""
    from station.drawing import draw

    return draw(recipe.plan, measurement)


def file_part(
    recipe: Recipe, measurement: Measurement, frames: Path, folder: Path, verdict: Verdict, ticket: Ticket
) -> None:
    """Writes the files of an inspection into `folder`. `frames`: the frames.json of the raw captures; its
    digest stands for the scan, for it holds the digest of each of them."""
    from station.document import Inputs
    from station.result import write_inspection

    inputs = Inputs(
        serial=ticket.serial,
        scan_sha256=file_sha256(frames),
        plan_sha256=recipe.plan_sha256,
        nominal_sha256=recipe.nominal_sha256,
        scan_name=frames.name,
        at_utc=ticket.at_utc,
        simulated=ticket.simulated,
    )
    write_inspection(folder, measurement, verdict, recipe.plan, inputs)
