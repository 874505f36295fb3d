"""The four-phase handshake with the PLC as a pure function of its registers and the time.

    IDLE       START with a new sequence     ACCEPTING   the request goes into the record
               START that cannot be served   REFUSED     until START falls
    ACCEPTING  in the record                 MEASURING
    MEASURING  verdict in the record         PUBLISHED
               continuity broken             STOPPING    the table stops, the request closes unjudged
    STOPPING   closed                        ABORTED     until START and RESULT_ACK are down
    PUBLISHED  RESULT_ACK, right ACK_SEQ     ACKING      the answer goes into the record
    ACKING     in the record                 CLEARING    until START and RESULT_ACK are down

`step` looks at the registers and says what must be done; the caller does it and reports back through
`accepted`, `published`, `closed` and `acked`. An acknowledgement counts as a level, so that one that
stands at a restart is seen; everything else about a request is keyed by its sequence.
"""

from dataclasses import dataclass, replace
from enum import StrEnum

from drivers.wire.plc import Ctrl, FaultCode, PlcRequest, StatusBits

ACK_ALARM_S = 30.0


class Phase(StrEnum):
    IDLE = "IDLE"
    ACCEPTING = "ACCEPTING"
    MEASURING = "MEASURING"
    STOPPING = "STOPPING"
    ABORTED = "ABORTED"
    REFUSED = "REFUSED"
    PUBLISHED = "PUBLISHED"
    ACKING = "ACKING"
    CLEARING = "CLEARING"


@dataclass(frozen=True, slots=True, kw_only=True)
class Seen:
    """What the station knows at one moment. `past_serial`: whose sequence this was, if it was used.
    `ready`: the station would take a part."""

    request: PlcRequest
    plc_alive: bool
    ready: bool
    recipe_known: bool
    past_serial: str | None
    accept_crc_zero: bool
    now_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Handshake:
    """Where the handshake stands. `held` is the request that is being served."""

    phase: Phase = Phase.IDLE
    sequence: int = 0
    serial: str | None = None
    held: PlcRequest | None = None
    fault_code: FaultCode = FaultCode.NONE
    reset_up: bool = True  # a level that stood before we could look is no edge
    published_s: float | None = None  # None: not published, or its lateness was told


@dataclass(frozen=True, slots=True, kw_only=True)
class Accept:
    """Write the request to the record, then `accepted`."""

    request: PlcRequest


@dataclass(frozen=True, slots=True, kw_only=True)
class Refuse:
    """Show the code; nothing is recorded, nothing moves. `reason`: alarm number, 0 for none."""

    code: FaultCode
    reason: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Unrefuse:
    """Take the code away again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Interrupt:
    """Stop the motion and close the request without a verdict, then `closed`."""

    alarm: int
    why: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Acked:
    """Write the PLC's answer to the record, then `acked`."""

    code: int


@dataclass(frozen=True, slots=True, kw_only=True)
class AckLate:
    """The verdict has stood unanswered for long; it keeps standing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Released:
    """START and RESULT_ACK are down again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ResetEdge:
    """The PLC asks for faults to be reset."""


Action = Accept | Refuse | Unrefuse | Interrupt | Acked | AckLate | Released | ResetEdge


def step(shake: Handshake, seen: Seen) -> tuple[Handshake, tuple[Action, ...]]:
    """The handshake after one look at the registers, and what must be done now."""
    up = seen.request.has(Ctrl.RESET_FAULT) if seen.plc_alive else True
    edge: tuple[Action, ...] = (ResetEdge(),) if up and not shake.reset_up else ()
    moved, action = _phase_step(replace(shake, reset_up=up), seen)
    return moved, edge if action is None else (*edge, action)


def _phase_step(shake: Handshake, seen: Seen) -> tuple[Handshake, Action | None]:
    request = seen.request
    down = not request.has(Ctrl.START)
    match shake.phase:
        case Phase.IDLE if not down and seen.plc_alive:
            return _asked(shake, seen)
        case Phase.MEASURING:
            broken = interruption(shake.held, seen)
            return (replace(shake, phase=Phase.STOPPING), broken) if broken else (shake, None)
        case Phase.PUBLISHED:
            return _waiting_for_ack(shake, seen)
        case Phase.REFUSED if down:
            return replace(shake, phase=Phase.IDLE, fault_code=FaultCode.NONE), Unrefuse()
        case Phase.ABORTED | Phase.CLEARING if down and not request.has(Ctrl.RESULT_ACK):
            return replace(shake, phase=Phase.IDLE, held=None), Released()
    return shake, None


def _asked(shake: Handshake, seen: Seen) -> tuple[Handshake, Action | None]:
    refusal = refused(seen)
    if refusal is not None:
        return replace(shake, phase=Phase.REFUSED, fault_code=refusal.code), refusal
    if not (seen.ready and seen.request.has(Ctrl.ENABLE)) or seen.request.has(Ctrl.RESULT_ACK):
        return shake, None
    accepting = Handshake(
        phase=Phase.ACCEPTING,
        sequence=seen.request.sequence,
        serial=seen.request.serial,
        held=seen.request,
        reset_up=shake.reset_up,
    )
    return accepting, Accept(request=seen.request)


def refused(seen: Seen) -> Refuse | None:
    """Why this request can never be served, or None."""
    request = seen.request
    if not request.crc_ok(accept_zero=seen.accept_crc_zero):
        return Refuse(code=FaultCode.BAD_CRC)
    if seen.past_serial is not None and request.serial not in (None, seen.past_serial):
        return Refuse(code=FaultCode.SEQUENCE_REUSED)
    if seen.past_serial is not None:
        return Refuse(code=FaultCode.NEW_SEQUENCE_NEEDED, reason=306)
    if request.serial is None:
        return Refuse(code=FaultCode.NEW_SEQUENCE_NEEDED, reason=213)
    if not seen.recipe_known:
        return Refuse(code=FaultCode.UNKNOWN_RECIPE)
    return None


def interruption(held: PlcRequest | None, seen: Seen) -> Interrupt | None:
    """What broke the continuity of the part since it was accepted, or None.

    A fallen START breaks nothing, nor does a request for another sequence: it is not looked at."""
    request = seen.request
    if not seen.plc_alive:
        return Interrupt(alarm=121, why="the PLC's heartbeat stopped")
    if held is not None and request.epoch != held.epoch:
        return Interrupt(alarm=121, why="the PLC started anew")
    if not request.has(Ctrl.PART_PRESENT):
        return Interrupt(alarm=206, why="PART_PRESENT fell")
    if held is not None and request.has(Ctrl.PART_CHANGED) and not held.has(Ctrl.PART_CHANGED):
        return Interrupt(alarm=131, why="the part was taken out or changed")
    if request.has(Ctrl.ABORT):
        return Interrupt(alarm=214, why="the PLC aborts")
    if not request.has(Ctrl.ENABLE):
        return Interrupt(alarm=214, why="ENABLE fell")
    return None


def _waiting_for_ack(shake: Handshake, seen: Seen) -> tuple[Handshake, Action | None]:
    request = seen.request
    if request.has(Ctrl.RESULT_ACK) and request.ack_sequence == shake.sequence:
        return replace(shake, phase=Phase.ACKING), Acked(code=request.ack_code)
    if shake.published_s is not None and seen.now_s - shake.published_s >= ACK_ALARM_S:
        return replace(shake, published_s=None), AckLate()
    return shake, None


def accepted(shake: Handshake) -> Handshake:
    """After the request is in the record: the part is being measured."""
    return replace(shake, phase=Phase.MEASURING)


def published(shake: Handshake, sequence: int, serial: str, now_s: float) -> Handshake:
    """After a verdict stands in the registers: of the request in hand, or again after a restart."""
    return replace(shake, phase=Phase.PUBLISHED, sequence=sequence, serial=serial, published_s=now_s)


def broken_off(shake: Handshake) -> Handshake:
    """After the station itself gave the request up: the table is being stopped."""
    in_hand = shake.phase in (Phase.ACCEPTING, Phase.MEASURING)
    return replace(shake, phase=Phase.STOPPING) if in_hand else shake


def closed(shake: Handshake) -> Handshake:
    """After the interrupted request is closed and nothing moves; a published verdict keeps standing."""
    in_hand = shake.phase in (Phase.ACCEPTING, Phase.MEASURING, Phase.STOPPING)
    return replace(shake, phase=Phase.ABORTED) if in_hand else shake


def acked(shake: Handshake) -> Handshake:
    """After the acknowledgement is in the record."""
    return replace(shake, phase=Phase.CLEARING, published_s=None)


@dataclass(frozen=True, slots=True, kw_only=True)
class Health:
    """What the status word says beside the handshake. `moving`: homing, clearing or stopping."""

    ready: bool
    faulted: bool
    moving: bool
    plc_alive: bool
    manual: bool
    safe_to_unload: bool
    calibration_due: bool


def status(shake: Handshake, request: PlcRequest, health: Health) -> StatusBits:
    """Register 100. START_ACK and BUSY together: the part is being measured, and nothing else."""
    standing = (Phase.MEASURING, Phase.PUBLISHED, Phase.ACKING)
    reused = (
        shake.phase in standing
        and request.has(Ctrl.START)
        and request.sequence == shake.sequence
        and request.serial != shake.serial
    )
    idle = shake.phase is Phase.IDLE and request.has(Ctrl.ENABLE) and not request.has(Ctrl.RESULT_ACK)
    bits = {
        StatusBits.ONLINE: True,
        StatusBits.READY: idle and health.ready and health.plc_alive,
        StatusBits.START_ACK: shake.phase in standing,
        StatusBits.BUSY: shake.phase in (Phase.MEASURING, Phase.STOPPING)
        or (health.moving and shake.phase not in standing),
        StatusBits.RESULT_VALID: shake.phase in (Phase.PUBLISHED, Phase.ACKING),
        StatusBits.FAULT: health.faulted,
        StatusBits.PLC_LOST: not health.plc_alive,
        StatusBits.MANUAL: health.manual,
        StatusBits.SEQ_REUSED: reused or shake.fault_code is FaultCode.SEQUENCE_REUSED,
        StatusBits.ABORTED: shake.phase in (Phase.STOPPING, Phase.ABORTED),
        StatusBits.SAFE_TO_UNLOAD: health.safe_to_unload,
        StatusBits.CAL_DUE: health.calibration_due,
    }
    word = StatusBits(0)
    for bit, up in bits.items():
        word |= bit if up else StatusBits(0)
    return word
