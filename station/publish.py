"""CommittedVerdict -> registers: the only way to the PLC."""

from collections.abc import Iterable

from drivers.wire.plc import ResultBlock, VerdictCode
from geometry.types import Measurand
from station.measurement import Measurement
from station.proof import Figures
from station.record import CommittedVerdict
from station.verdict import Verdict

_S32, _U32, _U16 = 2**31 - 1, 2**32 - 1, 2**16 - 1


def result_block(committed: CommittedVerdict) -> ResultBlock:
    """Registers 104-139 of a verdict as the record holds it; the same each time it is asked for."""
    ticket, decision = committed.ticket, committed.decision
    return ResultBlock(
        sequence=ticket.sequence,
        verdict=VerdictCode[decision.verdict],
        reason=decision.reason_no,
        worst_deviation_um=decision.figures.worst_um,
        missing_volume_mm3_x1000=decision.figures.missing_mm3_x1000,
        defects=decision.figures.defects,
        coverage_percent_x100=decision.figures.coverage_x100,
        serial=ticket.serial,
        record_id=committed.record_no,
        time_ms=decision.decided_ms,
    )


def figures(measurement: Measurement, verdict: Verdict) -> Figures:
    """What the PLC sees beside the word: the worst judged deviation in mm, the missing metal, the number
    of damages, and the coverage of the zone seen worst. A number too large for its register shows its end."""
    damages = measurement.damages or ()
    missing = [d.volume_mm3 for d in damages if d.kind.value == "missing"]
    return Figures(
        worst_um=_worst_um(verdict),
        missing_mm3_x1000=max(
            0,
            min(round(1000.0 * sum(each.value for each in missing if isinstance(each, Measurand))), _U32),
        ),
        defects=min(len(damages), _U16),
        coverage_x100=min((round(10_000.0 * zone.covered_fraction) for zone in measurement.zones), default=0),
    )


def _worst_um(verdict: Verdict) -> int:
    lengths = (f.deviation for f in verdict.findings if f.characteristic.endswith("_mm"))
    return _largest_um(deviation for deviation in lengths if deviation is not None)


def _largest_um(deviations_mm: Iterable[float]) -> int:
    worst = max(deviations_mm, key=abs, default=0.0)
    return max(-_S32, min(_S32, round(1000.0 * worst)))
