"""Each characteristic that the plan limits, against its limits: one finding each. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from math import isfinite
from typing import TYPE_CHECKING

from geometry.types import Measurand, Measured, NotMeasured, Zone
from station.plans import CountLimit, Limit, same_z

if TYPE_CHECKING:
    from geometry.damage.damages import Damage
    from geometry.sections.airfoil import Section
    from geometry.sections.blade_line import Judged
    from station.measurement import Measurement
    from station.plans import BladePlan

JUDGED_ZONES = (Zone.TIP, Zone.LEADING_EDGE, Zone.TRAILING_EDGE, Zone.SURFACE)
NO_PAIR = NotMeasured(reason="fewer than two sections")
UNITS = ("mm", "deg", "mm3")
PROFILE = ("profile_mm", "profile_form_mm")  # both of its ends are judged, the worse decides


class Outcome(StrEnum):
    PASS = "PASS"  # noqa: S105
    REPAIR = "REPAIR"
    SCRAP = "SCRAP"
    HOLD = "HOLD"
    NOT_JUDGED = "NOT_JUDGED"


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One characteristic against its limits. Without a number `reason` says why.

    `deviation` is from nominal and signed; damage sizes have none and are judged by `value`.
    """

    characteristic: str
    value: float | None = None
    deviation: float | None = None
    U: float | None = None
    serviceable: float | None = None
    repairable: float | None = None
    outcome: Outcome
    reason: str | None = None

    @property
    def judged(self) -> float | None:
        """The number that is held against the limits."""
        return self.value if self.deviation is None else abs(self.deviation)

    @property
    def proven_repairable(self) -> bool:
        """Whether the value is inside its repairable limit."""
        if self.judged is None or self.U is None or self.repairable is None:
            return False
        return self.judged + self.U <= self.repairable


def find(measurement: Measurement, plan: BladePlan) -> tuple[Finding, ...]:
    """One finding for every limit of the plan, and one for damage in a zone without a depth limit."""
    return (
        *section_findings(measurement, plan),
        *blade_findings(measurement, plan),
        *form_findings(measurement, plan),
        *damage_findings(measurement, plan),
    )


def outcome_of(judged: float, U: float, limit: Limit) -> Outcome:
    """Where a value with its expanded uncertainty lies; HOLD wherever nothing is proven."""
    if not (isfinite(judged) and isfinite(U)):
        return Outcome.HOLD
    if judged - U > limit.repairable:
        return Outcome.SCRAP
    if not judged + U <= limit.repairable:
        return Outcome.HOLD
    if judged + U <= limit.serviceable:
        return Outcome.PASS
    return Outcome.REPAIR if judged - U > limit.serviceable else Outcome.HOLD


def measured_finding(name: str, limit: Limit, value: float, U: float, nominal: float | None) -> Finding:
    """The finding of a number; `nominal` is None for sizes of damage."""
    deviation = None if nominal is None else value - nominal
    return Finding(
        characteristic=name,
        value=value,
        deviation=deviation,
        U=U,
        serviceable=limit.serviceable,
        repairable=limit.repairable,
        outcome=outcome_of(value if deviation is None else abs(deviation), U, limit),
    )


def unmeasured_finding(name: str, limit: Limit | None, reason: str, outcome: Outcome) -> Finding:
    """The finding of a characteristic without a number."""
    return Finding(
        characteristic=name,
        serviceable=limit.serviceable if limit else None,
        repairable=limit.repairable if limit else None,
        outcome=outcome,
        reason=reason,
    )


def section_findings(measurement: Measurement, plan: BladePlan) -> Iterator[Finding]:
    """One finding for each limited characteristic of each section of the plan."""
    k = plan.measurement.coverage_factor
    damaged = any(True for _ in judged_damages(measurement))
    for z_mm in plan.sections.z_mm:
        section = next((each for each in measurement.sections if same_z(each.z_mm, z_mm)), None)
        for key, limit in plan.limits.section.at(z_mm).items():
            each, nominal = characteristic(section, key)
            excused = each if damaged else [doubted(measured) for measured in each]
            yield worst_finding(f"sections[{z_mm}].{key}", limit, excused, nominal, k)


def doubted(measured: Measured) -> Measured:
    """`measured`, no longer excused by damage, for none was found whose limits judge that metal."""
    if isinstance(measured, NotMeasured) and measured.in_damage:
        return NotMeasured(reason=f"{measured.reason}, but no damage was found there")
    return measured


def worst_finding(name: str, limit: Limit, each: Sequence[Measured], nominal: float, k: float) -> Finding:
    """The finding of several values under one limit: each is judged, and the worst decides.

    A value with a large uncertainty does not hide behind a larger one that is better known. What damage
    excuses decides only where there is nothing else.
    """
    findings = [section_finding(name, limit, measured, nominal, k) for measured in each]
    return min(findings, key=lambda found: (severity(found), -(found.judged or 0.0)))


def section_finding(name: str, limit: Limit, measured: Measured, nominal: float, k: float) -> Finding:
    """The finding of one characteristic of one section."""
    if isinstance(measured, NotMeasured):
        outcome = Outcome.NOT_JUDGED if measured.in_damage else Outcome.HOLD
        return unmeasured_finding(name, limit, measured.reason, outcome)
    if not isfinite(nominal):
        return unmeasured_finding(name, limit, "the nominal has no such value", Outcome.HOLD)
    return measured_finding(name, limit, measured.value, k * measured.sigma, nominal)


def characteristic(section: Section | None, key: str) -> tuple[Sequence[Measured], float]:
    """What was measured for a limited key, and its nominal value (NaN: the nominal has none)."""
    if section is None:
        return [NotMeasured(reason="the section was not measured")], 0.0
    absent = NotMeasured(reason=section.reason or "was not measured")
    if key.endswith(PROFILE):
        ends = (f"{key.removesuffix('_mm')}_{end}_mm" for end in ("max", "min"))
        return [section.measurands.get(end, absent) for end in ends], 0.0
    return [section.measurands.get(key, absent)], section.nominals.get(key, float("nan"))


def blade_findings(measurement: Measurement, plan: BladePlan) -> Iterator[Finding]:
    """The findings of what the sections say together."""
    k, line = plan.measurement.coverage_factor, measurement.line
    for key, limit in plan.limits.blade.given().items():
        name = f"blade.{key}"
        if line is None:
            yield unmeasured_finding(name, limit, "the sections were not measured", Outcome.HOLD)
        elif key == "relative_twist_deg":
            twists = [twist.twist_deg.measured for twist in line.relative_twist]
            yield worst_finding(name, limit, twists or [NO_PAIR], 0.0, k)
        else:
            judged: Judged = getattr(line, key)
            nominal = float("nan") if judged.nominal is None else judged.nominal
            yield section_finding(name, limit, judged.measured, nominal, k)


def form_findings(measurement: Measurement, plan: BladePlan) -> Iterator[Finding]:
    """The finding of the twin against the nominal, or of metal bent farther off it, if limited."""
    limit, k = plan.limits.form.deviation_mm, plan.measurement.coverage_factor
    if limit is not None:
        each = [measurement.form_mm, *(damage.off_nominal_mm for damage in bent(measurement))]
        yield worst_finding("form.deviation_mm", limit, [doubted(measured) for measured in each], 0.0, k)


def judged_damages(measurement: Measurement) -> Iterator[tuple[int, Damage]]:
    """Metal missing or in excess on the airfoil, which limits of damage judge, with its index."""
    for index, damage in enumerate(measurement.damages or ()):
        if damage.zone in JUDGED_ZONES and damage.kind.value != "deformation":
            yield index, damage


def bent(measurement: Measurement) -> Iterator[Damage]:
    """Bent metal, which limits of sections and of form judge."""
    return (damage for damage in measurement.damages or () if damage.kind.value == "deformation")


def damage_findings(measurement: Measurement, plan: BladePlan) -> Iterator[Finding]:
    """The findings of every zone that has limits or damage."""
    for zone in JUDGED_ZONES:
        limits = plan.limits.of_zone(zone)
        damages = [damage for _, damage in judged_damages(measurement) if damage.zone == zone]
        if limits.depth_mm:
            yield depth_finding(zone, limits.depth_mm, damages, measurement, plan)
        elif damages:
            reason = f"{len(damages)} damage(s) in a zone without a depth limit"
            yield unmeasured_finding(f"damage.{zone}.depth_mm", None, reason, Outcome.HOLD)
        if limits.volume_mm3:
            yield volume_finding(zone, limits.volume_mm3, damages, measurement, plan)
        if limits.count:
            yield count_finding(zone, limits.count, damages, measurement, plan)


SEVERITY = (Outcome.SCRAP, Outcome.HOLD, Outcome.REPAIR, Outcome.PASS, Outcome.NOT_JUDGED)


def depth_finding(
    zone: Zone, limit: Limit, damages: Sequence[Damage], measurement: Measurement, plan: BladePlan
) -> Finding:
    """The finding of the damage that decides in a zone: the worst outcome, the deepest of these.

    Without any damage the depth is 0 with the detection limit as its uncertainty.
    """
    name, k = f"damage.{zone}.depth_mm", plan.measurement.coverage_factor
    if measurement.damages is None:
        return unmeasured_finding(name, limit, "damage was not looked for", Outcome.HOLD)
    if not damages:
        return nothing_found(name, limit, measurement.detection_mm.get(zone))
    each = [height_finding(name, limit, damage, k) for damage in damages]
    return min(each, key=lambda found: (severity(found), -(found.value or 0.0)))


def severity(finding: Finding) -> tuple[int, bool]:
    """Orders findings, the one that decides first: a borderline value that is proven repairable yields
    to a proven exceedance, for it cannot make the part better."""
    borderline = finding.outcome == Outcome.HOLD and finding.proven_repairable
    rank = SEVERITY.index(Outcome.REPAIR if borderline else finding.outcome)
    return rank, borderline


def height_finding(name: str, limit: Limit, damage: Damage, k: float) -> Finding:
    """The finding of the depth of one damage. What stands on the skin and closes off no volume may be no
    metal, a fibre or a reflection: it scraps no part."""
    finding = size_finding(name, limit, damage.depth_mm, k)
    volume = damage.volume_mm3
    if damage.kind.value == "excess" and isinstance(volume, NotMeasured) and finding.outcome == Outcome.SCRAP:
        return unmeasured_finding(name, limit, f"its volume: {volume.reason}", Outcome.HOLD)
    return finding


def size_finding(name: str, limit: Limit, size: Measured, k: float) -> Finding:
    """The finding of the size of one damage."""
    if isinstance(size, NotMeasured):
        return unmeasured_finding(name, limit, size.reason, Outcome.HOLD)
    return measured_finding(name, limit, size.value, k * size.sigma, None)


def nothing_found(name: str, limit: Limit, detection: Measured | None) -> Finding:
    """The finding of a zone without damage: nothing deeper than the detection limit is there."""
    match detection:
        case Measurand(value=value):
            return measured_finding(name, limit, 0.0, value, None)
        case NotMeasured(reason=reason):
            return unmeasured_finding(name, limit, f"no detection limit: {reason}", Outcome.HOLD)
    return unmeasured_finding(name, limit, "no detection limit", Outcome.HOLD)


def volume_finding(
    zone: Zone, limit: Limit, damages: Sequence[Damage], measurement: Measurement, plan: BladePlan
) -> Finding:
    """The finding of the summed volume of a zone. What is measured may prove SCRAP without the rest.

    The errors of neighbouring damages have one twin in common, so their uncertainties are added.
    """
    name = f"damage.{zone}.volume_mm3"
    if measurement.damages is None:
        return unmeasured_finding(name, limit, "damage was not looked for", Outcome.HOLD)
    if not damages and not isinstance(measurement.detection_mm.get(zone), Measurand):
        return nothing_found(name, limit, measurement.detection_mm.get(zone))
    measured = [damage.volume_mm3 for damage in damages if isinstance(damage.volume_mm3, Measurand)]
    U = plan.measurement.coverage_factor * sum(volume.sigma for volume in measured)
    finding = measured_finding(name, limit, sum((volume.value for volume in measured), 0.0), U, None)
    reasons = [damage.volume_mm3.reason for damage in damages if isinstance(damage.volume_mm3, NotMeasured)]
    if reasons and finding.outcome != Outcome.SCRAP:
        return unmeasured_finding(name, limit, reasons[0], Outcome.HOLD)
    return finding


def count_finding(
    zone: Zone, limit: CountLimit, damages: Sequence[Damage], measurement: Measurement, plan: BladePlan
) -> Finding:
    """The finding of the number of damages in a zone that are proven deeper than the smallest that counts."""
    name = f"damage.{zone}.count"
    detection = measurement.detection_mm.get(zone)
    least_mm = limit.min_depth_mm
    if least_mm is None and isinstance(detection, Measurand):
        least_mm = detection.value
    if measurement.damages is None:
        return unmeasured_finding(name, limit, "damage was not looked for", Outcome.HOLD)
    if not isinstance(detection, Measurand) and (not damages or least_mm is None):
        return nothing_found(name, limit, detection)
    deeper = [d for d in damages if proven_deeper(d.depth_mm, least_mm or 0.0, plan)]
    return measured_finding(name, limit, float(len(deeper)), 0.0, None)


def proven_deeper(depth: Measured, least_mm: float, plan: BladePlan) -> bool:
    """Whether a depth is beyond `least_mm`."""
    if isinstance(depth, NotMeasured):
        return False
    return depth.value - plan.measurement.coverage_factor * depth.sigma > least_mm


def described(finding: Finding) -> str:
    """One line for a person: `tip: depth 8.21 mm > serviceable 0.13 mm`."""
    place, _, key = finding.characteristic.rpartition(".")
    name, unit = spelled(key)
    where = place.removeprefix("damage.").replace("_", " ").replace("sections[", "section ").rstrip("]")
    if finding.judged is None or finding.U is None:
        return f"{where}: {name}: {finding.reason}"
    return f"{where}: {name} {finding.judged:.4g}{unit} {against(finding, unit)}"


def spelled(key: str) -> tuple[str, str]:
    """The name of a characteristic in words and its unit with a leading space."""
    name, _, unit = key.rpartition("_")
    return (name.replace("_", " "), f" {unit}") if unit in UNITS else (key.replace("_", " "), "")


def against(finding: Finding, unit: str) -> str:
    """How a value lies to the limit that decides."""
    match finding.outcome:
        case Outcome.SCRAP:
            return f"> repairable {finding.repairable:g}{unit}"
        case Outcome.REPAIR:
            return f"> serviceable {finding.serviceable:g}{unit}"
        case Outcome.PASS:
            return f"<= serviceable {finding.serviceable:g}{unit}"
    which = "serviceable" if finding.proven_repairable else "repairable"
    limit = finding.serviceable if finding.proven_repairable else finding.repairable
    return f"+- {finding.U:.2g}{unit} is neither inside nor beyond {which} {limit:g}{unit}"
