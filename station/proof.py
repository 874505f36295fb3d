"""A decision as the record keeps it, and its second computation from the kept numbers alone.

`unproven` knows nothing of the measurement and shares no code with the verdict: it looks only at the
stored findings and asks whether they carry the stored word. HOLD needs a reason; every other word needs
proof. A decision that does not prove itself is never committed and never published.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from math import isfinite
from typing import Any, Self

from station.events import FindingRow, VerdictWord

EVIDENCE = ("alignment", "coverage", "damage", "steps")


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """The numbers that the PLC sees beside the verdict, in the units of its registers."""

    worst_um: int = 0
    missing_mm3_x1000: int = 0
    defects: int = 0
    coverage_x100: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """One verdict with all that carries it. `gates`: each must be true for any word but HOLD. `evidence`:
    whether the alignment was accepted, the surface seen, damage looked for and every step made; SCRAP needs
    the alignment, PASS and REPAIR all of them.
    `reason_no`: the number of docs/wire/plc.md, 0 for PASS. `files`: SHA-256 by path in the job folder."""

    verdict: VerdictWord
    route: str | None
    reasons: tuple[str, ...]
    findings: tuple[FindingRow, ...]
    gates: Mapping[str, bool]
    evidence: Mapping[str, bool]
    reason_no: int
    figures: Figures
    files: Mapping[str, str]
    decided_ms: int
    decided_utc: str
    interrupted: bool = False  # closed without a measurement: never published

    @classmethod
    def from_body(cls, body: Mapping[str, Any]) -> Self:
        """The decision of a stored entry."""
        fields = dict(body)
        fields["reasons"] = tuple(fields["reasons"])
        fields["findings"] = tuple(FindingRow(**row) for row in fields["findings"])
        fields["figures"] = Figures(**fields["figures"])
        return cls(**fields)

    def body(self) -> dict[str, Any]:
        """What the record stores."""
        return asdict(self)


def unproven(decision: Decision) -> str | None:
    """Why the stored numbers do not carry the stored word; None when they do."""
    if decision.interrupted and decision.verdict != "HOLD":
        return "an interrupted request has no verdict"
    if decision.verdict == "HOLD":
        return None if decision.reasons else "a HOLD without a reason"
    needed = {**decision.gates, **_needed_evidence(decision)}
    lacking = [name for name, holds in needed.items() if holds is not True]
    if lacking or not decision.gates:
        return f"does not hold: {', '.join(lacking) or 'no gate was checked'}"
    wrong = [row.characteristic for row in decision.findings if not _carried(row)]
    if wrong:
        return f"{wrong[0]}: its numbers do not carry its outcome"
    return _word_without_proof(decision)


def _needed_evidence(decision: Decision) -> dict[str, bool]:
    names = ("alignment",) if decision.verdict == "SCRAP" else EVIDENCE
    return {name: decision.evidence.get(name, False) for name in names}


def _word_without_proof(decision: Decision) -> str | None:
    outcomes = [row.outcome for row in decision.findings]
    match decision.verdict:
        case "PASS":
            proven = "PASS" in outcomes and set(outcomes) <= {"PASS", "NOT_JUDGED"}
        case "REPAIR":
            # Borderline at a serviceable limit is HOLD by itself; beside a proven exceedance it is repaired.
            proven = "REPAIR" in outcomes and all(_repairable(row) for row in decision.findings)
        case "SCRAP":
            proven = "SCRAP" in outcomes
        case _:
            return f"{decision.verdict!r} is not a verdict"
    return None if proven else f"the findings do not add up to {decision.verdict}"


def _carried(row: FindingRow) -> bool:
    if row.outcome in ("HOLD", "NOT_JUDGED"):
        return True
    judged = _judged(row)
    if judged is None:
        return False
    value, U, serviceable, repairable = judged
    match row.outcome:
        case "PASS":
            return value + U <= serviceable
        case "REPAIR":
            return value - U > serviceable and value + U <= repairable
        case "SCRAP":
            return value - U > repairable
    return False


def _repairable(row: FindingRow) -> bool:
    if row.outcome in ("PASS", "REPAIR", "NOT_JUDGED"):
        return True
    judged = _judged(row)
    return row.outcome == "HOLD" and judged is not None and judged[0] + judged[1] <= judged[3]


def _judged(row: FindingRow) -> tuple[float, float, float, float] | None:
    value = row.value if row.deviation is None else abs(row.deviation)
    if value is None or row.U is None or row.serviceable is None or row.repairable is None:
        return None
    numbers = (value, row.U, row.serviceable, row.repairable)
    return numbers if all(isfinite(number) for number in numbers) and row.U >= 0.0 else None
