"""All that the geometry found out about one part, or why it could not."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from geometry.types import Floats, Measured, NotMeasured, Zone

if TYPE_CHECKING:  # the rooms behind these types are heavy, and who only judges or shows needs none of them
    from geometry.coverage import ZoneCoverage
    from geometry.damage.damages import Damage
    from geometry.registration.alignment import Alignment
    from geometry.registration.datums import ServiceMotion
    from geometry.repair.patches import RepairVolume
    from geometry.sections.airfoil import Section
    from geometry.sections.blade_line import BladeLine
    from geometry.types import Mesh

NO_POINTS = np.empty((0, 3))
NO_VALUES = np.empty(0)
NO_TWIN = NotMeasured(reason="there is no damage-free twin")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outline:
    """The nominal section curve at `z_mm`: closed, counter-clockwise, nominal frame."""

    z_mm: float
    curve_mm: Floats  # (m, 2)
    le_mm: Floats  # (2,)
    te_mm: Floats  # (2,)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measurement:
    """What is not there was not measured: `failures` names the step and says why.

    `None` and an empty tuple differ: `damages` is None when nobody could look, empty when none was found.
    `service` is how the airfoil stands against its root, where the plan names a datum zone.
    `aligned_mm` (n, 3) is the cleaned scan in the nominal frame, `deviation_mm` (n,) its signed distance
    to the nominal, positive outside. `detection_mm` is the depth of damage that is surely found in a
    zone, where it covers `detection_mm2`. `residual_mm` is what the twin leaves of the sound points: noise,
    without the form of the part. `layered_fraction` is the share of the cleaned points on damages under or
    over skin that was scanned as well.
    `timing_s` counts the seconds of each step.
    """

    points: int  # as read, before cleaning
    merge_mm: float | None = None  # standard uncertainty along the normal that merging left to a point
    alignment: Alignment | None = None
    service: ServiceMotion | NotMeasured | None = None
    aligned_mm: Floats = field(default_factory=lambda: NO_POINTS)
    deviation_mm: Floats = field(default_factory=lambda: NO_VALUES)
    sections: tuple[Section, ...] = ()
    line: BladeLine | None = None
    outlines: tuple[Outline, ...] = ()
    twin_mesh: Mesh | None = None
    form_mm: Measured = NO_TWIN
    residual_mm: float | None = None
    damages: tuple[Damage, ...] | None = None
    layered_fraction: float = 0.0
    detection_mm: Mapping[Zone, Measured] = field(default_factory=dict)
    detection_mm2: Measured = NO_TWIN
    repairs: RepairVolume | None = None
    zones: tuple[ZoneCoverage, ...] = ()
    failures: Mapping[str, str] = field(default_factory=dict)
    timing_s: Mapping[str, float] = field(default_factory=dict)
