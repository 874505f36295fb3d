"""A closed section curve -> position, orientation, chord, thickness, edges, profile deviation."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

from geometry.types import Floats, Measured


class SectionStatus(StrEnum):
    MEASURED = "measured"
    PARTIAL = "partial"
    IN_DAMAGE = "in_damage"
    NOT_COVERED = "not_covered"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Section:
    """One inspected section, nominal frame.

    `measurands` has every name in SECTION_MEASURANDS; one whose support touches a damage is
    `NotMeasured(..., in_damage=True)`. `nominals` gives the nominal value of each.
    `profile_mm` (m, 2) are points of the measured profile where it was measured, in order,
    `deviation_mm` (m,) their signed distance to the nominal section (positive outside), `run` (m,) numbers
    the unbroken stretches, so that nobody draws a line across a gap.
    """

    z_mm: float
    status: SectionStatus
    reason: str | None
    covered_fraction: float
    measurands: Mapping[str, Measured]
    nominals: Mapping[str, float]
    profile_mm: Floats
    deviation_mm: Floats
    run: Floats
