"""Measurement, plan and gates -> one of four words, with the proof. Pure.

The value judged is the deviation from nominal of sections and form, and the size of damages. With
U = k * sigma a value is *inside* a limit L when value + U <= L and *beyond* it when value - U > L.
The first that applies decides:

    1  HOLD    alignment not accepted, or a gate of the cell open
    2  SCRAP   a value beyond its repairable limit, whatever is unmeasured elsewhere
    3  HOLD    surface unseen, something required unmeasured, a damage that no limit judges,
               a value neither inside nor beyond its repairable limit, damage that could be overlooked
    4  REPAIR  a value beyond its serviceable limit; metal that is missing has a valid patch (else HOLD)
    5  PASS    every value inside its serviceable limit, and at least one
    6  HOLD    borderline
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Literal

from geometry.types import Measurand, Measured
from station.findings import Finding, Outcome, bent, described, find, judged_damages
from station.gates import ACCEPTANCE, Acceptance, Cause, Gates, Reason, alignment_doubts, open_gates

if TYPE_CHECKING:
    from geometry.coverage import ZoneCoverage
    from geometry.damage.damages import Damage
    from geometry.repair.patches import Patch
    from station.measurement import Measurement
    from station.plans import BladePlan

Route = Literal["fill", "rework"]


class Word(StrEnum):
    PASS = "PASS"  # noqa: S105
    REPAIR = "REPAIR"
    SCRAP = "SCRAP"
    HOLD = "HOLD"


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The word, its proof, and the indices of the patches that put back what is missing."""

    verdict: Word
    route: Route | None
    because: tuple[Reason, ...]
    findings: tuple[Finding, ...]
    patches: tuple[int, ...]

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why, one line each, what decided first."""
        return tuple(reason.text for reason in self.because)


def judge(
    measurement: Measurement, plan: BladePlan, gates: Gates, acceptance: Acceptance = ACCEPTANCE
) -> Verdict:
    """The verdict on a measurement. It starts as HOLD and becomes another word by proof only."""
    findings = find(measurement, plan)
    word, because = decide(measurement, plan, gates, acceptance, findings)
    distrusted = any(reason.cause == Cause.ALIGNMENT for reason in because)
    patches = () if distrusted else tuple(valid_patches(measurement, plan, findings).values())
    return Verdict(
        verdict=word,
        route=route_of(patches) if word == Word.REPAIR else None,
        because=because,
        findings=findings,
        patches=patches,
    )


def decide(
    measurement: Measurement,
    plan: BladePlan,
    gates: Gates,
    acceptance: Acceptance,
    findings: Sequence[Finding],
) -> tuple[Word, tuple[Reason, ...]]:
    """The word and why, by the first rule that applies."""
    distrust = (*alignment_doubts(measurement, plan, acceptance), *open_gates(gates))
    beyond_repair = reasons_of(findings, Outcome.SCRAP, Cause.BEYOND_REPAIRABLE)
    unproven = tuple(doubts(measurement, plan, findings))
    beyond_service = reasons_of(findings, Outcome.REPAIR, Cause.BEYOND_SERVICEABLE)
    unpatched = tuple(missing_patches(measurement, plan, findings))
    borderline = reasons_of(findings, Outcome.HOLD, Cause.BORDERLINE)
    inside = reasons_of(findings, Outcome.PASS, Cause.INSIDE)

    if distrust:
        return Word.HOLD, distrust
    if beyond_repair:
        return Word.SCRAP, beyond_repair
    if unproven:
        return Word.HOLD, unproven
    if beyond_service:
        return (Word.HOLD, unpatched) if unpatched else (Word.REPAIR, beyond_service)
    if borderline:
        return Word.HOLD, borderline
    if inside:
        return Word.PASS, all_inside(len(inside))
    return Word.HOLD, (Reason(cause=Cause.NOTHING_JUDGED, text="no characteristic could be judged"),)


def all_inside(count: int) -> tuple[Reason, ...]:
    return (
        Reason(cause=Cause.INSIDE, text=f"all {count} values judged are inside their serviceable limits"),
    )


def route_of(patches: Sequence[int]) -> Route:
    """Fill where metal is put back; otherwise rework."""
    return "fill" if patches else "rework"


def reasons_of(findings: Sequence[Finding], outcome: Outcome, cause: Cause) -> tuple[Reason, ...]:
    """A reason for each finding with this outcome."""
    return tuple(Reason(cause=cause, text=described(f)) for f in findings if f.outcome == outcome)


def doubts(measurement: Measurement, plan: BladePlan, findings: Sequence[Finding]) -> Iterator[Reason]:
    """All that keeps a part from any word but HOLD, once no value is beyond repair."""
    for step, why in measurement.failures.items():
        yield Reason(cause=Cause.FAILED_STEP, text=f"{step}: {why}")
    yield from unseen(measurement, plan)
    for finding in findings:
        if finding.outcome == Outcome.HOLD and not finding.proven_repairable:
            cause = Cause.NOT_MEASURED if finding.judged is None else Cause.UNDECIDED
            yield Reason(cause=cause, text=described(finding))
    yield from overlooked(measurement, plan)
    if plan.limits.form.deviation_mm is None:
        yield from unjudged_bends(measurement, plan, findings)


def unjudged_bends(
    measurement: Measurement, plan: BladePlan, findings: Sequence[Finding]
) -> Iterator[Reason]:
    """Bent metal through which no section passes that has a number for a limit, where the form has none."""
    numbers = {finding.characteristic for finding in findings if finding.judged is not None}
    judged_mm = [
        z_mm
        for z_mm in plan.sections.z_mm
        if any(f"sections[{z_mm}].{key}" in numbers for key in plan.limits.section.at(z_mm))
    ]
    for damage in bent(measurement):
        low_mm, high_mm = damage.span_mm
        if not any(low_mm <= z_mm <= high_mm for z_mm in judged_mm):
            where = f"deformation at z {low_mm:.1f} to {high_mm:.1f} mm"
            text = f"{where}: neither form nor a section there was judged"
            yield Reason(cause=Cause.NOT_MEASURED, text=text)


def unseen(measurement: Measurement, plan: BladePlan) -> Iterator[Reason]:
    """The zones of the required surface that were not seen."""
    if not measurement.zones:
        yield Reason(cause=Cause.UNSEEN, text="coverage: was not measured")
    there = {zone.zone for zone in measurement.zones}
    for name, limits in plan.limits.damage.items():
        if measurement.zones and name not in there and limits:
            text = f"{name.replace('_', ' ')}: has limits, but no surface of it is required to be seen"
            yield Reason(cause=Cause.UNSEEN, text=text)
    for zone in measurement.zones:
        if not is_seen(zone, plan):
            text = (
                f"{zone.zone.replace('_', ' ')}: {100 * zone.covered_fraction:.1f} % seen, "
                f"largest gap {zone.largest_gap_mm:.2f} mm"
            )
            yield Reason(cause=Cause.UNSEEN, text=text)


def is_seen(zone: ZoneCoverage, plan: BladePlan) -> bool:
    return (
        zone.status.value == "seen"
        and zone.covered_fraction >= plan.coverage.min_fraction
        and zone.largest_gap_mm <= plan.coverage.max_gap_mm
    )


def overlooked(measurement: Measurement, plan: BladePlan) -> Iterator[Reason]:
    """The zones in which damage beyond its serviceable depth could have been overlooked."""
    for name, limits in plan.limits.damage.items():
        detection = next((d for zone, d in measurement.detection_mm.items() if zone == name), None)
        if limits.depth_mm is None:
            continue
        why = blindness(detection, limits.depth_mm.serviceable, plan.measurement.coverage_factor)
        if why:
            yield Reason(cause=Cause.DETECTION, text=f"{name.replace('_', ' ')}: {why}")


def blindness(detection: Measured | None, serviceable_mm: float, k: float) -> str | None:
    """Why damage beyond its serviceable depth would not surely be found; None when it would."""
    if not isinstance(detection, Measurand):
        return f"no detection limit: {detection.reason if detection else 'was not measured'}"
    if detection.value <= serviceable_mm - k * detection.sigma:
        return None
    return f"damage is found from {detection.value:.3f} mm depth on, serviceable is {serviceable_mm:g} mm"


def missing_patches(
    measurement: Measurement, plan: BladePlan, findings: Sequence[Finding]
) -> Iterator[Reason]:
    """Why a damage that must be filled has no valid patch."""
    patched = valid_patches(measurement, plan, findings)
    failures = measurement.repairs.failures if measurement.repairs else {}
    for index, damage in to_fill(measurement, plan, findings):
        if index not in patched:
            why = failures.get(index, "there is no valid patch")
            yield Reason(cause=Cause.NO_PATCH, text=f"{damage.zone.replace('_', ' ')}: repair: {why}")


def valid_patches(measurement: Measurement, plan: BladePlan, findings: Sequence[Finding]) -> dict[int, int]:
    """Index of the valid patch by index of the damage that must be filled."""
    needed = {index for index, _ in to_fill(measurement, plan, findings)}
    patches = measurement.repairs.patches if measurement.repairs else ()
    return {patch.damage: i for i, patch in enumerate(patches) if patch.damage in needed and is_valid(patch)}


def is_valid(patch: Patch) -> bool:
    return patch.watertight is True and patch.volume_mm3.value > 0.0


def to_fill(
    measurement: Measurement, plan: BladePlan, findings: Sequence[Finding]
) -> Iterator[tuple[int, Damage]]:
    """The missing metal that is not inside all its serviceable limits. A serviceable nick is left alone."""
    inside = {finding.characteristic for finding in findings if finding.outcome == Outcome.PASS}
    for index, damage in judged_damages(measurement):
        if damage.kind.value == "missing" and not is_serviceable(damage, plan, inside):
            yield index, damage


def is_serviceable(damage: Damage, plan: BladePlan, inside: set[str]) -> bool:
    """Whether a damage is inside its serviceable depth, and its zone inside the other two limits."""
    limits, depth = plan.limits.of_zone(damage.zone), damage.depth_mm
    if limits.depth_mm is None or not isinstance(depth, Measurand):
        return False
    U = plan.measurement.coverage_factor * depth.sigma
    rest = [name for name in ("volume_mm3", "count") if getattr(limits, name) is not None]
    return depth.value + U <= limits.depth_mm.serviceable and all(
        f"damage.{damage.zone}.{name}" in inside for name in rest
    )
