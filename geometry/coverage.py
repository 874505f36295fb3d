"""Was every required part of the surface seen? By zone, by area and by largest gap."""

from dataclasses import dataclass
from enum import StrEnum

from geometry.types import Zone


class CoverageStatus(StrEnum):
    SEEN = "seen"  # sound, or absent inside a damage whose broken surface was seen
    UNSEEN = "unseen"


@dataclass(frozen=True, slots=True, kw_only=True)
class CoverageSettings:
    min_fraction: float = 0.95
    max_gap_mm: float = 1.5


@dataclass(frozen=True, slots=True, kw_only=True)
class ZoneCoverage:
    """One zone of the required surface. `covered_fraction` counts area seen or absent; the gap is
    the diameter of the largest empty disc on what is neither."""

    zone: Zone
    covered_fraction: float
    absent_fraction: float
    largest_gap_mm: float
    status: CoverageStatus
