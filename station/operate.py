"""The station from its start to its end: recover, get ready, serve requests, fault, reset.

run_forever ── operate ── serve ── serve_next ── serve_request ── cycle.run_part
                  └─ abort: the table stops, the operator is told, a reset proves the causes gone
"""

import asyncio
import shutil
from collections.abc import Callable, Coroutine
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any

from drivers.errors import DeviceFault, DriverError, LinkDown
from drivers.wire.plc import Ctrl, PlcRequest
from station import alarms as engine
from station import handshake as shaking
from station.attend import attend, keep_answers, recorded, show_status, take_intents, tick
from station.cell import WARM_S, Cell, RecipeFile, utc_now
from station.chain import RecordFailed
from station.cycle import LOAD_DEG, PartInterrupted, in_place, publish, run_part
from station.daily import daily_gate
from station.events import PartStarted
from station.handshake import Phase
from station.job import begin_job, close_abandoned, close_unjudged, recover
from station.phases import Trigger
from station.reasons import Unfit, alarm_number
from station.record import Ticket

CHECK_S = 1.0
MIN_FREE_BYTES = 256 << 20
SHOWN_PARTS = 20

_SERVED = (Phase.ACCEPTING, Phase.PUBLISHED, Phase.ACKING)
SHOWN = (Phase.PUBLISHED, Phase.ACKING, Phase.CLEARING)  # a verdict stands in the registers


async def run_forever(cell: Cell) -> None:
    """Serves the PLC until `cell.leave()`."""
    await boot(cell)
    beside = (attend(cell), keep_answers(cell), take_intents(cell))
    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(each) for each in beside]
        while not cell.leaving:
            await operate(cell)
        for task in tasks:
            task.cancel()


async def boot(cell: Cell) -> None:
    """Closes what an end of the station interrupted, and shows a verdict that still stands."""
    cell.tell_state("starts")
    cell.device("record", "READY", str(cell.config.record_directory))
    interrupted, standing = await cell.on_disk(recover, cell.record, datetime.now(UTC))
    for request in cell.record.requests()[-SHOWN_PARTS:]:
        cell.emit(recorded(request))
    for request in interrupted:
        cell.alarm(131, request.ticket.serial, lasting=False)
    cell.fire(Trigger.CHECKED)
    if standing is not None:
        publish(cell, standing)
        if cell.record.request(standing.record_no).phase != "PUBLISHED":
            await cell.on_disk(cell.record.published, standing.record_no, utc_now())


async def operate(cell: Cell) -> None:
    """Serves until stopped or failed. The second of the two places where errors end."""
    cell.serving = asyncio.create_task(serve(cell))
    try:
        await cell.serving
    except asyncio.CancelledError:
        this = asyncio.current_task()
        if this is not None and this.cancelling():
            raise
        if (failure := cell.failure) is None:
            await halt(cell)
        else:
            await abort(cell, failure)
    except Exception as error:  # whatever it was: the table stops and a person is told
        await abort(cell, error)


async def serve(cell: Cell) -> None:
    """From STOPPED to ready, then request after request."""
    await called(cell)
    cell.fire(Trigger.START)
    await get_ready(cell)
    cell.fire(Trigger.READY)
    while True:
        await serve_next(cell)


async def called(cell: Cell) -> None:
    """Returns when the station is wanted, by an operator or, headless, by the PLC's ENABLE too."""

    def enabled() -> bool:
        return not cell.headless or cell.plc.request().has(Ctrl.ENABLE)

    while not (cell.wanted and enabled()):
        if not cell.wanted:
            cell.tell_state("waits for START")
            await cell.until(lambda: cell.wanted)
        else:
            cell.tell_state("waits for ENABLE of the PLC")
            await cell.until(lambda: enabled() or not cell.wanted)


async def get_ready(cell: Cell) -> None:
    """Returns when the devices are connected and homed and the worker is warm."""
    check_fit(cell)
    await warm_worker(cell)
    await cell.connect()
    turntable, _ = in_place(cell)
    cell.device("turntable", "BUSY", "homes")
    await turntable.home()
    await turntable.move_to(LOAD_DEG)
    cell.device("turntable", "READY", "homed")


async def warm_worker(cell: Cell) -> None:
    """Returns when the geometry worker waits for orders."""
    if not cell.worker.alive:
        cell.device("worker", "CONNECTING", "prepares the nominal, compiles its kernels")
        await cell.worker.start(WARM_S)
    cell.device("worker", "READY", f"process {cell.worker.pid}")


def check_fit(cell: Cell) -> None:
    """Raises `Unfit` for what would make every verdict a HOLD or lose it."""
    if cell.calibration.scanner_serial != cell.config.scanner.serial:
        raise Unfit(134, "the calibration is of another scanner")
    if cell.calibration_left_days() < 0.0:
        raise Unfit(134, "the calibration has expired or lies in the future")
    if not (daily := daily_gate(cell.config, datetime.now(UTC))).holds:
        raise Unfit(134, f"the daily check: {daily.reason}")
    free_bytes = shutil.disk_usage(cell.config.record_directory).free
    if free_bytes < MIN_FREE_BYTES:
        raise Unfit(132, f"{free_bytes >> 20} MB free")


async def serve_next(cell: Cell) -> None:
    """One request from READY to READY, or a verdict that still stands from an earlier run."""
    await watch(cell, lambda: cell.shake.phase in _SERVED)
    if cell.shake.phase is Phase.ACCEPTING and cell.shake.held is not None:
        await serve_request(cell, cell.shake.held)
    elif cell.shake.phase is Phase.PUBLISHED:
        cell.fire(Trigger.PUBLISHED, "a verdict waits for its acknowledgement")
    await watch(cell, lambda: cell.shake.phase not in _SERVED)
    cell.fire(Trigger.ACKED)
    check_fit(cell)
    await warm_worker(cell)
    await check_devices(cell)
    await watch(cell, lambda: cell.shake.phase is Phase.IDLE)
    cell.fire(Trigger.RELEASED)


async def serve_request(cell: Cell, request: PlcRequest) -> None:
    """Measures the part of a request, or closes the request if that is interrupted."""
    recipe = cell.recipes[request.recipe]
    ticket = ticket_of(cell, request, recipe)
    record_no = await cell.on_disk(cell.record.accept, ticket)
    cell.interrupt = None
    cell.settle(engine.next_part(cell.alarms))
    cell.plc.clear_result()
    cell.shake = shaking.accepted(cell.shake)
    tick(cell)
    cell.fire(Trigger.REQUEST, f"{ticket.serial} on recipe {ticket.recipe}")
    announce(cell, ticket, recipe, record_no)
    try:
        if cell.shake.phase is not Phase.MEASURING:
            raise PartInterrupted
        cell.part = asyncio.create_task(inspect_part(cell, recipe, ticket, record_no))
        await cell.part
    except (asyncio.CancelledError, PartInterrupted):
        await to_its_end(break_off(cell, record_no))
        if asked_to_end():
            raise asyncio.CancelledError from None
        if cell.interrupt is None:
            raise
    finally:
        cell.part = None


async def inspect_part(cell: Cell, recipe: RecipeFile, ticket: Ticket, record_no: int) -> None:
    """Opens the job of an accepted request and runs it."""
    turntable, scanner = in_place(cell)
    identity, status = turntable.identity, await turntable.status()
    devices = {
        "turntable": {
            "port": turntable.port,
            "device_id": identity.device_id,
            "microsteps_per_turn": identity.microsteps_per_turn,
            "angle_deg": status.angle_deg,
            "flags": list(status.flags),
        },
        "scanner": {"host": scanner.host, "serial": scanner.serial},
        "station": {"id": cell.config.station_id, "mode": cell.config.mode, "version": cell.version},
    }
    job = await cell.on_disk(begin_job, cell.record, record_no, ticket, recipe.inputs, devices)
    await run_part(cell, recipe, job)


async def to_its_end(closing: Coroutine[Any, Any, None]) -> None:
    """Awaits what must not be left half done, however often this task is asked to end meanwhile."""
    task = asyncio.ensure_future(closing)
    while not task.done():
        with suppress(asyncio.CancelledError):
            await asyncio.shield(task)
    task.result()


def asked_to_end() -> bool:
    """Whether this task itself was cancelled, not one that it awaited."""
    task = asyncio.current_task()
    return task is not None and task.cancelling() > 0


async def break_off(cell: Cell, record_no: int) -> None:
    """Stops the table and closes a request that was interrupted: without a verdict, whatever was decided.

    One whose verdict already stands in the registers, or was taken from there, is past interruption."""
    if cell.shake.phase in SHOWN or cell.record.request(record_no).phase not in ("ACCEPTED", "DECIDED"):
        return
    cell.shake = shaking.broken_off(cell.shake)
    show_status(cell)
    await cell.stop_motion()
    alarm, why = (
        (cell.interrupt.alarm, cell.interrupt.why) if cell.interrupt else (214, "the station was stopped")
    )
    await cell.on_disk(close_unjudged, cell.record, record_no, alarm, why, datetime.now(UTC))
    cell.alarm(alarm, f"{cell.record.request(record_no).ticket.serial}: {why}", lasting=False)
    cell.emit(recorded(cell.record.request(record_no)))
    cell.shake = shaking.closed(cell.shake)
    cell.fire(Trigger.INTERRUPTED, why)


def ticket_of(cell: Cell, request: PlcRequest, recipe: RecipeFile) -> Ticket:
    """The request as it goes into the record."""
    return Ticket(
        sequence=request.sequence,
        serial=request.serial or "",
        recipe=request.recipe,
        fixture=request.fixture,
        plc_epoch=request.epoch,
        part_number=recipe.plan.part_number,
        simulated=cell.config.mode == "SIMULATION",
        at_utc=utc_now(),
    )


def announce(cell: Cell, ticket: Ticket, recipe: RecipeFile, record_no: int) -> None:
    """Shows the screens which part is on the table."""
    cell.emit(
        PartStarted(
            serial=ticket.serial,
            sequence=ticket.sequence,
            recipe=ticket.recipe,
            part_number=ticket.part_number,
            views=len(recipe.plan.scan.angles_deg),
            record_no=record_no,
            at_utc=ticket.at_utc,
        )
    )


async def watch(cell: Cell, holds: Callable[[], bool]) -> None:
    """Returns when `holds`; meanwhile looks after the devices once a second."""
    while True:
        if not await cell.until(lambda: holds() or cell.jog_deg is not None, CHECK_S):
            await check_devices(cell)
        elif cell.jog_deg is not None:
            await jog(cell)
        else:
            return


async def check_devices(cell: Cell) -> None:
    """Raises a `DriverError` when a device is gone, not homed, or does not run.

    The scanner's link is opened anew if it is down: an interrupted capture leaves its control channel
    closed, for its replies carry no id."""
    turntable, scanner = in_place(cell)
    status = await turntable.status()
    if not status.homed:
        raise DeviceFault("turntable", turntable.port, "lost its reference")
    try:
        await scanner.prepare()
    except LinkDown as error:
        cell.log("info", f"the scanner is connected again: {error}")
        await cell.connect_scanner()


async def jog(cell: Cell) -> None:
    """Turns the table by the small step that a person asked for."""
    turntable, _ = in_place(cell)
    step_deg, cell.jog_deg = cell.jog_deg or 0.0, None
    await turntable.move_to((await turntable.status()).angle_deg + step_deg)


async def halt(cell: Cell) -> None:
    """Stops because people or the system asked for it."""
    cell.fire(Trigger.STOP)
    await cell.stop_motion()
    cell.shake = shaking.closed(cell.shake)
    cell.fire(Trigger.STOPPED)


async def abort(cell: Cell, error: Exception) -> None:
    """Stops because of a failure, and returns when a reset has proven its cause gone."""
    number, cell.failure, cell.reset_by = alarm_number(error), None, None
    cell.fire(Trigger.FAULT, str(error))
    cell.alarm(number, str(error) if not isinstance(error, AssertionError) else repr(error))
    if isinstance(error, DriverError):
        cell.device(error.device, "FAULT", str(error))
    await cell.stop_motion()
    await cell.disconnect()
    cell.shake = shaking.closed(cell.shake)
    show_status(cell)
    cell.fire(Trigger.SAFE)
    while not cell.leaving:
        await cell.until(lambda: cell.reset_asked or cell.leaving)
        if cell.reset_asked and await cleared(cell):
            return


async def cleared(cell: Cell) -> bool:
    """Whether devices and store work again, so that the alarms could be cleared."""
    by_person, cell.reset_by = cell.reset_by == "operator", None
    if not by_person and any(alarm.kind.person for alarm in cell.alarms.standing):
        cell.log("warning", "this fault is cleared by the operator only")
        return False
    cell.fire(Trigger.RESET)
    try:
        await cell.reopen_record()
        cell.moved.set()  # an acknowledgement may wait for the store
        now, shown = datetime.now(UTC), cell.shake.phase in SHOWN
        await cell.on_disk(close_abandoned, cell.record, "a fault ended the inspection", now, shown=shown)
        await cell.connect()
        check_fit(cell)
    except (DriverError, RecordFailed, Unfit) as error:
        cell.fire(Trigger.FAULT, str(error))
        cell.alarm(alarm_number(error), str(error))
        cell.fire(Trigger.SAFE)
        return False
    for alarm in cell.alarms.standing:
        cell.settle(engine.cause_gone(cell.alarms, alarm.kind.number))
    cell.settle(engine.reset(engine.acknowledged(cell.alarms), by_person=by_person))
    cell.fire(Trigger.CLEARED)
    return True
