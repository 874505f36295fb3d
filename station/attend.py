"""What goes on beside the procedure: the handshake's pulse, the PLC's answers, the operator's intents.

`tick` looks at the registers and acts in one synchronous step, twenty times a second and whenever the PLC
writes; it never waits for a disk or a device.
"""

from drivers.wire.plc import Ctrl, FaultCode
from station import alarms as engine
from station import handshake as shaking
from station.cell import Cell, utc_now
from station.chain import RecordFailed
from station.events import (
    Acknowledge,
    Handshake,
    Intent,
    Jog,
    PartRecorded,
    Reset,
    Start,
    Stop,
    VerdictAcknowledged,
    printable,
)
from station.handshake import (
    Accept,
    Acked,
    AckLate,
    Action,
    Interrupt,
    Phase,
    Refuse,
    Released,
    ResetEdge,
    Seen,
    Unrefuse,
)
from station.phases import State, Trigger
from station.record import Request

TICK_S = 0.05
LARGEST_JOG_DEG = 30.0


async def attend(cell: Cell) -> None:
    """The pulse of the station: ends only when it is cancelled."""
    while True:
        await cell.plc.wait_change(TICK_S)
        tick(cell)


def tick(cell: Cell) -> None:
    """One look at the registers, what follows from it, and the status word."""
    now_s = cell.clock()
    cell.plc.beat(now_s)
    watch_plc(cell, cell.plc.plc_alive(now_s))
    cell.shake, actions = shaking.step(cell.shake, look(cell, now_s))
    for action in actions:
        act(cell, action)
    show_status(cell)


def look(cell: Cell, now_s: float) -> Seen:
    """What the handshake decides by."""
    request = cell.plc.request()
    past = cell.record.past(request.sequence)
    return Seen(
        request=request,
        plc_alive=cell.plc.plc_alive(now_s),
        ready=cell.ready,
        recipe_known=request.recipe in cell.recipes,
        past_serial=past.ticket.serial if past else None,
        accept_crc_zero=cell.config.plc.accept_crc_zero,
        now_s=now_s,
    )


def watch_plc(cell: Cell, alive: bool) -> None:
    """Suspends an idle station while the PLC is silent."""
    if cell.state is State.IDLE and not alive:
        cell.fire(Trigger.PLC_LOST, "waits for the heartbeat of the PLC")
    elif cell.state is State.SUSPENDED and alive:
        cell.fire(Trigger.PLC_BACK)
    if alive != cell.plc_seen:
        cell.plc_seen = alive
        cell.device("plc", "READY" if alive else "OFFLINE", f"epoch {cell.plc.request().epoch}")
        if alive:
            cell.settle(engine.cause_gone(cell.alarms, 121))
        else:
            cell.alarm(121)


def act(cell: Cell, action: Action) -> None:
    """Does what the handshake asks for, or leaves it to whom it concerns."""
    match action:
        case Refuse(code=code, reason=reason):
            refuse(cell, code, reason)
        case Unrefuse():
            cell.plc.clear_result()
        case Interrupt():
            cell.interrupt = action
            cell.log("warning", f"request {cell.shake.sequence} is interrupted: {action.why}")
            if cell.part is not None:
                cell.part.cancel()
        case AckLate():
            cell.alarm(124, f"request {cell.shake.sequence}")
        case ResetEdge():
            asked_to_reset(cell, by="plc")
        case Accept() | Acked() | Released():
            pass  # the procedure waits for the phase itself
    cell.moved.set()


def refuse(cell: Cell, code: FaultCode, reason: int) -> None:
    """Shows why the request is not taken."""
    request = cell.plc.request()
    cell.log("warning", f"request {request.sequence} is refused: {code.name}, serial {request.serial}")
    if reason in engine.KINDS:
        cell.alarm(reason, f"request {request.sequence}", lasting=False)
    cell.plc.refuse(code, reason, cell.plc.status)


def show_status(cell: Cell) -> None:
    """Writes the status word, and tells the screens what changed."""
    now_s, request = cell.clock(), cell.plc.request()
    bits = shaking.status(cell.shake, request, cell.health(now_s))
    cell.plc.set_status(bits)
    shown = Handshake(
        plc_bits=tuple(bit.name or "" for bit in Ctrl if bit in request.ctrl),
        station_bits=tuple(bit.name or "" for bit in type(bits) if bit in bits),
        sequence=request.sequence,
        plc_heartbeat=request.heartbeat,
        station_heartbeat=cell.plc.heartbeat,
        plc_alive=cell.plc.plc_alive(now_s),
    )
    if shown != cell.shown:
        cell.shown = shown
        cell.emit(shown)
        cell.moved.set()


async def keep_answers(cell: Cell) -> None:
    """Enters every acknowledgement into the record before RESULT_VALID falls. Never ends by itself.

    A store that failed may have kept the entry all the same: once it is open again, it is asked."""
    while True:
        await cell.until(lambda: cell.shake.phase is Phase.ACKING and not cell.record.failed)
        request, code = cell.record.past(cell.shake.sequence), cell.plc.request().ack_code
        assert request is not None
        if request.phase == "ACKED":
            code = request.ack_code or 0
        else:
            try:
                await cell.on_disk(cell.record.acked, request.record_no, code, utc_now())
            except RecordFailed as error:
                cell.fail(error)
                if not cell.record.failed:
                    await cell.until(lambda: cell.shake.phase is not Phase.ACKING)
                continue
        cell.shake = shaking.acked(cell.shake)
        cell.plc.clear_result()
        show_status(cell)
        cell.settle(engine.cause_gone(cell.alarms, 124))
        tell_answer(cell, request, code)
        cell.moved.set()


def tell_answer(cell: Cell, request: Request, code: int) -> None:
    """Shows the operator what the PLC did with the part."""
    ticket = request.ticket
    cell.emit(
        VerdictAcknowledged(
            serial=ticket.serial, sequence=ticket.sequence, record_no=request.record_no, code=code
        )
    )
    cell.emit(recorded(cell.record.request(request.record_no)))
    if code != 1:
        cell.log("warning", f"{ticket.serial}: the verdict was not executed, answer {code}")


def recorded(request: Request) -> PartRecorded:
    """The line of a request in the list of results."""
    decision = request.decision
    return PartRecorded(
        record_no=request.record_no,
        serial=request.ticket.serial,
        sequence=request.ticket.sequence,
        verdict=decision.verdict if decision and request.phase != "UNDELIVERED" else "HOLD",
        reason=decision.reasons[0] if decision and decision.reasons else "",
        acknowledged=request.ack_code is not None,
        at_utc=decision.decided_utc if decision else request.ticket.at_utc,
    )


async def take_intents(cell: Cell) -> None:
    """Enters what people ask for into the record, then does it; a stop at once. Never ends by itself."""
    while True:
        intent = await cell.intents.get()
        if isinstance(intent, Stop):
            heed(cell, intent)  # waits for no disk
        try:
            await cell.on_disk(cell.record.operator, printable(repr(intent)), utc_now())
        except RecordFailed as error:
            cell.log("error", f"{error}")
        if not isinstance(intent, Stop):
            heed(cell, intent)


def heed(cell: Cell, intent: Intent) -> None:
    """Does what a person asked for, where the state allows it."""
    match intent:
        case Start():
            cell.wanted = True
        case Stop():
            cell.wanted = False
            if cell.serving is not None and cell.state is not State.STOPPED:
                cell.serving.cancel()
        case Acknowledge():
            cell.settle(engine.acknowledged(cell.alarms))
        case Reset():
            asked_to_reset(cell, by="operator")
        case Jog(step_deg=step_deg):
            if cell.config.mode == "MAINTENANCE" and abs(step_deg) <= LARGEST_JOG_DEG:
                cell.jog_deg = step_deg
            else:
                cell.log("warning", "jogging is for mode MAINTENANCE, in small steps")
    cell.moved.set()


def asked_to_reset(cell: Cell, *, by: str) -> None:
    """Resets what can be; a faulted station goes on to prove that the causes are gone.

    The PLC's edge counts as having seen the alarms: nobody stands at a headless cell."""
    if by == "plc":
        cell.settle(engine.acknowledged(cell.alarms))
    cell.settle(engine.reset(cell.alarms, by_person=by == "operator"))
    if cell.state is State.ABORTED:
        cell.reset_by = "operator" if by == "operator" else "plc"
