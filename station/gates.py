"""Whether a measurement may be judged at all: its alignment is accepted and the cell's gates hold. Pure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import TYPE_CHECKING

from geometry.errors import BadInput
from geometry.transforms import check_rigid

if TYPE_CHECKING:
    from geometry.registration.alignment import Alignment
    from station.measurement import Measurement
    from station.plans import BladePlan


class Cause(StrEnum):
    """What a reason is about."""

    ALIGNMENT = "alignment"
    GATE = "gate"
    BEYOND_REPAIRABLE = "beyond repairable"
    FAILED_STEP = "failed step"
    UNSEEN = "unseen"
    NOT_MEASURED = "not measured"
    UNDECIDED = "undecided"
    DETECTION = "detection"
    BEYOND_SERVICEABLE = "beyond serviceable"
    NO_PATCH = "no patch"
    BORDERLINE = "borderline"
    INSIDE = "inside"
    NOTHING_JUDGED = "nothing judged"


@dataclass(frozen=True, slots=True, kw_only=True)
class Reason:
    cause: Cause
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Gate:
    """Something of the cell that must hold for any word but HOLD; `reason` says why it does not."""

    holds: bool
    reason: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Gates:
    """What must hold of the cell. None has a default: forgetting one is not holding it."""

    calibration: Gate
    daily_check: Gate
    continuity: Gate
    mode: Gate


@dataclass(frozen=True, slots=True, kw_only=True)
class Acceptance:
    """When an alignment is trusted."""

    min_runner_up_ratio: float = 1.5
    min_explained_fraction: float = 0.8
    max_noise_ratio: float = 2.0  # of the noise found to the plan's sigma_mm
    max_layered_fraction: float = 0.002  # of the points; more than a fibre that lies on the blade


ACCEPTANCE = Acceptance()


def alignment_doubts(measurement: Measurement, plan: BladePlan, acceptance: Acceptance) -> Iterator[Reason]:
    """Why the alignment is not accepted."""
    if measurement.alignment is None:
        why = next(iter(measurement.failures.values()), "there is none")
        yield Reason(cause=Cause.ALIGNMENT, text=f"alignment: {why}")
        return
    for text in pose_doubts(measurement.alignment, acceptance):
        yield Reason(cause=Cause.ALIGNMENT, text=f"alignment: {text}")
    if not measurement.layered_fraction <= acceptance.max_layered_fraction:
        percent = 100.0 * measurement.layered_fraction
        text = f"scan: {percent:.1f} % of its points are a second layer of the skin: did the part move?"
        yield Reason(cause=Cause.ALIGNMENT, text=text)
    noise_mm, sigma_mm = noise_of(measurement, measurement.alignment, plan), plan.measurement.sigma_mm
    if not noise_mm <= acceptance.max_noise_ratio * sigma_mm:
        text = f"noise: the scan scatters by {noise_mm:.3g} mm, the plan states {sigma_mm:g} mm"
        yield Reason(cause=Cause.ALIGNMENT, text=text)


def pose_doubts(alignment: Alignment, acceptance: Acceptance) -> Iterator[str]:
    """What is wrong with a pose. Each test is written so that a NaN fails it."""
    if not alignment.converged:
        yield f"did not converge in {alignment.iterations} iterations"
    if not alignment.runner_up_ratio >= acceptance.min_runner_up_ratio:
        yield f"ambiguous, another pose fits nearly as well (ratio {alignment.runner_up_ratio:.2f})"
    if alignment.weak_directions:
        yield f"the surface leaves {len(alignment.weak_directions)} direction(s) free"
    if not alignment.explained_fraction >= acceptance.min_explained_fraction:
        percent = 100.0 * alignment.explained_fraction
        yield f"the nominal explains only {percent:.0f} % of the points: a wrong part?"
    try:
        check_rigid(alignment.T_nominal_scan, "the pose")
    except BadInput as error:
        yield str(error)


def noise_of(measurement: Measurement, alignment: Alignment, plan: BladePlan) -> float:
    """Scatter of the scan along the normal in mm. Residuals to the nominal hold the part's form as well;
    those to its twin do not. An alignment on a part of the blade knows the scatter of that part only."""
    if measurement.residual_mm is None:
        return alignment.noise_mm
    if plan.alignment.method != "airfoil":
        return measurement.residual_mm
    return min(alignment.noise_mm, measurement.residual_mm)


def open_gates(gates: Gates) -> Iterator[Reason]:
    """What of the cell does not hold."""
    for field in fields(gates):
        gate: Gate = getattr(gates, field.name)
        if gate.holds is not True:
            yield Reason(cause=Cause.GATE, text=f"{field.name.replace('_', ' ')}: {gate.reason or 'open'}")
