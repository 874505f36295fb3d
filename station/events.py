"""What the cell tells its screens, and what they may ask of it: frozen values and their JSON lines.

One event or intent is one line: `{"event": "PartStarted", "serial": ..., ...}`. Decoding is total: any
bytes give a value or a `BadEvent`. Strings are reduced to printable ASCII on the way out and on the
way in, so that neither a serial number nor a device reply can move a cursor. Points and curves travel
as base64 of little-endian float32 (`pack` and `unpack`).
"""

import base64
import binascii
import json
from dataclasses import asdict, dataclass
from math import isfinite
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

MAX_LINE_BYTES = 4 << 20
MAX_VIEW_POINTS = 4_000
MAX_CLOUD_POINTS = 30_000

DeviceState = Literal["OFFLINE", "CONNECTING", "READY", "BUSY", "FAULT"]
VerdictWord = Literal["PASS", "REPAIR", "SCRAP", "HOLD"]


@dataclass(frozen=True, slots=True, kw_only=True)
class StationStatus:
    """The inner state (`phases.State`), its PackML number (TR88) and one sentence for the operator."""

    state: str
    mode: str
    packml: int
    station_id: str
    version: str
    detail: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceStatus:
    """One of turntable, scanner, plc, worker, record."""

    device: str
    state: DeviceState
    detail: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Handshake:
    """The two words of the PLC handshake as bit names that are set, and the two heartbeats."""

    plc_bits: tuple[str, ...]
    station_bits: tuple[str, ...]
    sequence: int
    plc_heartbeat: int
    station_heartbeat: int
    plc_alive: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class PartStarted:
    """A request was accepted. `views` captures will follow."""

    serial: str
    sequence: int
    recipe: int
    part_number: str
    views: int
    record_no: int
    at_utc: str


@dataclass(frozen=True, slots=True, kw_only=True)
class StepStarted:
    """One step of the procedure: scan, clean, register, sections, twin, damage, repair, judge, record."""

    step: str


@dataclass(frozen=True, slots=True, kw_only=True)
class StepFinished:
    step: str
    duration_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewCaptured:
    """View `index` (from 0) of `total`; `sample_mm` packs at most 4,000 points (n, 3) in the table
    frame at 0 degrees, so that samples of all views lie on each other."""

    index: int
    total: int
    angle_deg: float
    points: int
    sample_mm: str


@dataclass(frozen=True, slots=True, kw_only=True)
class CloudMeasured:
    """The aligned scan: `points_mm` (n, 3) nominal frame, `deviation_mm` (n,) positive outside.

    `serviceable_mm` and `repairable_mm` are the profile limits of the plan, for the colour bands."""

    points_mm: str
    deviation_mm: str
    serviceable_mm: float | None
    repairable_mm: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Value:
    """One number of a section; `value` is None where it was not measured, and `reason` says why."""

    name: str
    value: float | None
    sigma: float | None
    unit: str
    nominal: float | None
    reason: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SectionMeasured:
    """One section, nominal frame: `nominal_mm` packs a closed curve (m, 2), `profile_mm` (n, 2) the
    measured points in order, `deviation_mm` (n,), `run` (n,) the number of the unbroken stretch.
    `le_mm`, `te_mm`: where the edges of the nominal lie, for the zooms."""

    z_mm: float
    status: str
    nominal_mm: str
    profile_mm: str
    deviation_mm: str
    run: str
    le_mm: tuple[float, float]
    te_mm: tuple[float, float]
    serviceable_mm: float | None
    repairable_mm: float | None
    values: tuple[Value, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class FindingRow:
    """One judged characteristic."""

    characteristic: str
    value: float | None
    deviation: float | None
    U: float | None
    serviceable: float | None
    repairable: float | None
    outcome: str


@dataclass(frozen=True, slots=True, kw_only=True)
class VerdictReached:
    """The verdict as committed to the record, before it is shown to the PLC. Findings: worst first."""

    serial: str
    sequence: int
    part_number: str
    verdict: VerdictWord
    route: str | None
    reasons: tuple[str, ...]
    findings: tuple[FindingRow, ...]
    record_no: int
    durations_s: dict[str, float]
    simulated: bool
    at_utc: str


@dataclass(frozen=True, slots=True, kw_only=True)
class VerdictAcknowledged:
    """The PLC's answer: code 1 routed as told, 2 stale or not routed, 3 overridden by people."""

    serial: str
    sequence: int
    record_no: int
    code: int


@dataclass(frozen=True, slots=True, kw_only=True)
class PartRecorded:
    """One line of the results list; a snapshot holds the last 20."""

    record_no: int
    serial: str
    sequence: int
    verdict: VerdictWord
    reason: str
    acknowledged: bool
    at_utc: str


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmRaised:
    """`state`: UNACK (active), ACK (active, seen), RETURNED (cause gone, not seen), LATCHED (cause
    gone, seen, waits for reset). Sent again whenever the state changes."""

    number: int
    priority: Literal[1, 2, 3, 4]
    text: str
    action: str
    state: Literal["UNACK", "ACK", "RETURNED", "LATCHED"]
    first_out: bool
    at_utc: str


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmCleared:
    number: int


@dataclass(frozen=True, slots=True, kw_only=True)
class LogLine:
    level: Literal["debug", "info", "warning", "error"]
    text: str
    at_utc: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SnapshotEnd:
    """All before this line was the state at connection; what follows happens now."""


Event = (
    StationStatus
    | DeviceStatus
    | Handshake
    | PartStarted
    | StepStarted
    | StepFinished
    | ViewCaptured
    | CloudMeasured
    | SectionMeasured
    | VerdictReached
    | VerdictAcknowledged
    | PartRecorded
    | AlarmRaised
    | AlarmCleared
    | LogLine
    | SnapshotEnd
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """Leave STOPPED: home and become ready."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stop:
    """Stop the sequence; a part on the table gets HOLD. Not an emergency stop."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Acknowledge:
    """The operator has seen every alarm that is shown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reset:
    """Clear the latches whose cause is gone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Jog:
    """Turn the table by a small step; only in MAINTENANCE."""

    step_deg: float


Intent = Start | Stop | Acknowledge | Reset | Jog


@dataclass(frozen=True, slots=True, kw_only=True)
class BadEvent:
    """Why a line is neither an event nor an intent."""

    reason: str


_EVENTS: dict[str, TypeAdapter[Any]] = {kind.__name__: TypeAdapter(kind) for kind in Event.__args__}
_INTENTS: dict[str, TypeAdapter[Any]] = {kind.__name__: TypeAdapter(kind) for kind in Intent.__args__}


def encode(event: Event | Intent) -> bytes:
    """The line of an event or intent, newline included; `ValueError` for a number that is not finite."""
    fields = printable({"event": type(event).__name__, **asdict(event)})
    return json.dumps(fields, allow_nan=False, separators=(",", ":")).encode("ascii") + b"\n"


def decode(line: bytes) -> Event | BadEvent:
    """The event of a line that the station sent."""
    value: Event | BadEvent = _decode(line, _EVENTS)
    return value


def decode_intent(line: bytes) -> Intent | BadEvent:
    """The intent of a line that a screen sent."""
    value: Intent | BadEvent = _decode(line, _INTENTS)
    return value


def _decode(line: bytes, known: dict[str, TypeAdapter[Any]]) -> Any:
    if len(line) > MAX_LINE_BYTES:
        return BadEvent(reason=f"a line of {len(line)} bytes")
    try:
        fields = printable(json.loads(line, parse_float=_finite, parse_constant=_finite))
        return known[fields.pop("event")].validate_python(fields, extra="forbid")
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        return BadEvent(reason=printable(f"{error.title} {first['loc']}: {first['msg']}")[:200])
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        return BadEvent(reason=printable(f"{type(error).__name__}: {error}")[:200])


def _finite(text: str) -> float:
    number = float(text)
    if not isfinite(number):
        raise ValueError(f"{text} is not a finite number")
    return number


def printable(value: Any) -> Any:
    """The same JSON value with every character outside 0x20..0x7E replaced by `?`."""
    if isinstance(value, str):
        return value if value.isascii() and value.isprintable() else "".join(map(_visible, value))
    if isinstance(value, dict):
        return {printable(str(key)): printable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [printable(item) for item in value]
    return value


def _visible(character: str) -> str:
    return character if " " <= character <= "~" else "?"


def pack(array: NDArray[Any]) -> str:
    """The array as base64 of little-endian float32, row-major."""
    return base64.b64encode(np.ascontiguousarray(array, dtype="<f4").tobytes()).decode("ascii")


def unpack(text: str, columns: int = 1) -> NDArray[np.float32]:
    """The array (n, columns), or (n,) for one column; `ValueError` if the text is not such an array."""
    try:
        flat = np.frombuffer(base64.b64decode(text, validate=True), dtype="<f4")
    except binascii.Error as error:
        raise ValueError(f"not base64: {error}") from None
    if len(flat) % columns:
        raise ValueError(f"{len(flat)} numbers do not make rows of {columns}")
    return flat.astype(np.float32) if columns == 1 else flat.reshape(-1, columns).astype(np.float32)
