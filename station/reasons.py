"""The one number that the PLC sees for why: an alarm (station/alarms.py) or a characteristic.

Register 108 of docs/wire/plc.md. PASS has 0. REPAIR and SCRAP have the number of the first characteristic
that decided; HOLD has the number of the alarm that says what stood in the way.
"""

from drivers.errors import BadReply, DeviceFault, DriverError, Timeout
from station.chain import RecordBroken, RecordFailed
from station.gates import Cause, Gates
from station.verdict import Verdict, Word
from station.worker import WorkerFailed, WorkerTimeout

SECTION = {
    "position_mm": 401,
    "orientation_deg": 402,
    "profile_mm": 403,
    "chord_mm": 404,
    "max_thickness_mm": 405,
    "le_radius_mm": 406,
    "te_radius_mm": 407,
}
OTHER_OF_SECTION = 409
FORM = 410
BLADE = 460
DAMAGE = {"tip": 420, "leading_edge": 430, "trailing_edge": 440, "surface": 450}
SIZE = {"depth_mm": 1, "volume_mm3": 2, "count": 3}

HOLD_ALARM = {
    Cause.ALIGNMENT: 209,
    Cause.UNSEEN: 204,
    Cause.FAILED_STEP: 210,
    Cause.NOT_MEASURED: 210,
    Cause.NOTHING_JUDGED: 210,
    Cause.NO_PATCH: 211,
    Cause.UNDECIDED: 212,
    Cause.DETECTION: 212,
    Cause.BORDERLINE: 212,
}
GATE_ALARM = {"calibration": 134, "daily_check": 134, "continuity": 133, "mode": 133}


class Unfit(Exception):
    """The cell must not work as it is; `alarm` says what for."""

    def __init__(self, alarm: int, why: str) -> None:
        super().__init__(why)
        self.alarm = alarm


def characteristic_number(name: str) -> int:
    """The number of a characteristic as findings name it: `sections[7.0].chord_mm`, `damage.tip.depth_mm`."""
    place, _, key = name.rpartition(".")
    if place == "form":
        return FORM
    if place.startswith("sections["):
        return SECTION.get(key, OTHER_OF_SECTION)
    if place == "blade":
        return BLADE
    return DAMAGE[place.removeprefix("damage.")] + SIZE[key]


def reason_number(verdict: Verdict, gates: Gates) -> int:
    """Register 108 of a verdict."""
    if verdict.verdict == Word.PASS:
        return 0
    if verdict.verdict != Word.HOLD:
        deciding = next(f for f in verdict.findings if f.outcome.value == verdict.verdict.value)
        return characteristic_number(deciding.characteristic)
    cause = verdict.because[0].cause
    if cause == Cause.GATE:
        return next(alarm for name, alarm in GATE_ALARM.items() if getattr(gates, name).holds is not True)
    return HOLD_ALARM.get(cause, 210)


def alarm_number(error: BaseException) -> int:
    """The alarm that a failure of a device, of the worker or of the store raises."""
    match error:
        case DriverError(device="turntable"):
            return _turntable_alarm(error)
        case DriverError(device="scanner"):
            return _scanner_alarm(error)
        case DriverError():
            return 121
        case Unfit(alarm=alarm):
            return alarm
        case WorkerTimeout():
            return 215
        case WorkerFailed():
            return 216
        case RecordBroken():
            return 3
        case RecordFailed() | OSError():
            return 2
    return 136


_UNCERTAIN = ("reference", "homed", "homing", "drifted", "moved", "stopped at")


def _turntable_alarm(error: DriverError) -> int:
    if isinstance(error, DeviceFault):
        return 103 if any(word in error.what for word in _UNCERTAIN) else 102
    return 101


def _scanner_alarm(error: DriverError) -> int:
    match error:
        case Timeout():
            return 201
        case BadReply() if "scanner" in error.what or "version" in error.what:
            return 112
        case BadReply():
            return 202
    return 111


def ends_only_the_part(error: BaseException) -> bool:
    """Whether the cell may go on with the next part: the scanner answered, or only the sum failed."""
    if isinstance(error, DriverError):
        return error.device == "scanner" and alarm_number(error) in (201, 202)
    return isinstance(error, WorkerFailed)
