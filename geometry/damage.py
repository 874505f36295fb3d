"""Damage regions of the scan against the twin: zone, kind, depth, area."""

from dataclasses import dataclass
from enum import StrEnum

from geometry.types import Floats, Ints, Measured, Zone


class DamageKind(StrEnum):
    MISSING = "missing"
    EXCESS = "excess"
    DEFORMATION = "deformation"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Damage:
    """One damage, nominal frame. Depth: tip along the span from the twin's tip; edges in the
    section plane from the twin's edge; surface normal to the twin. A volume that could not be
    proven is `NotMeasured`, and so is a depth."""

    zone: Zone
    kind: DamageKind
    depth_mm: Measured
    area_mm2: Measured  # of the lost skin
    volume_mm3: Measured
    length_mm: float  # largest extent
    centroid_mm: Floats  # (3,)
    points: Ints  # indices of the scan points on the damaged surface
