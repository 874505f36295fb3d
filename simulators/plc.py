"""A PLC that walks the handshake against the station's registers, and trusts nothing that it reads.

`PlcProgram` is the ladder logic: one scan a call, time an argument, no socket. `run_plc` polls the station
with it. A part is on hold unless a verdict passes every check; only then is it routed, once.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ModbusException

from drivers.wire.errors import BadReply
from drivers.wire.plc import (
    FAULT_CODE,
    REQUEST_COUNT,
    RESULT,
    STATION_EPOCH,
    STATION_HEARTBEAT,
    STATUS,
    AckCode,
    Ctrl,
    PlcRequest,
    ResultBlock,
    StatusBits,
    decode_result,
    encode_request,
)

logging.getLogger("pymodbus.logging").addHandler(logging.NullHandler())
logging.getLogger("pymodbus.logging").propagate = False

STATION_COUNT = 40
_SCAN_S = 0.05
_CALL_S = 0.5
_BEAT_S = 0.5
_LOST_S = 2.0
_WRONG_READS = 3  # of the same block before it is given up
_PAUSE_S = 1.0  # between a refusal and the next request
_RESET_PERIOD_S = 5.0
_SILENCE_S = 12.0  # without START_ACK, BUSY or a verdict: the request is lost

Line = dict[str, Any]


class Phase(StrEnum):
    """Where the program stands."""

    EMPTY = "EMPTY"
    IDLE = "IDLE"
    WAIT = "WAIT"
    ACK = "ACK"
    DONE = "DONE"


@dataclass(frozen=True, slots=True, kw_only=True)
class StationImage:
    """Registers 100-139 of one read."""

    status: StatusBits
    heartbeat: int
    epoch: int
    fault_code: int
    block: tuple[int, ...]

    @property
    def sequence(self) -> int:
        """RES_SEQ."""
        return self.block[0] << 16 | self.block[1]

    def shows(self, bits: StatusBits) -> bool:
        """Whether all of these status bits are set."""
        return self.status & bits == bits


def decode_image(registers: Sequence[int]) -> StationImage:
    """The image in registers 100-139."""
    if len(registers) != STATION_COUNT:
        raise BadReply("station", "", f"{len(registers)} registers, want {STATION_COUNT}")
    return StationImage(
        status=StatusBits(registers[0]),
        heartbeat=registers[STATION_HEARTBEAT - STATUS],
        epoch=registers[STATION_EPOCH - STATUS],
        fault_code=registers[FAULT_CODE - STATUS],
        block=tuple(registers[RESULT - STATUS :]),
    )


@dataclass(slots=True, kw_only=True)
class PlcProgram:
    """The logic of one loading station: put a part in, ask, check, route, take it out.

    `first_sequence` stands for the retentive counter: no two programs may use the same numbers.
    `parts` None: never stop.
    """

    first_sequence: int
    epoch: int
    recipe: int = 1
    parts: int | None = None
    phase: Phase = Phase.EMPTY
    index: int = 0
    serial: str | None = None
    out: PlcRequest = field(default_factory=PlcRequest)
    log: list[Line] = field(default_factory=list)
    part_changed: bool = True  # the latch of the nest; after a start it counts as set
    _heard: int | None = None
    _heard_at_s: float = float("-inf")
    _beaten_at_s: float = float("-inf")
    _resume_at_s: float = float("-inf")
    _faulty_since_s: float | None = None
    _answered_at_s: float = float("-inf")
    _wrong_reads: int = 0
    _routed: bool = False

    def __post_init__(self) -> None:
        self.out = replace(self.out, epoch=self.epoch, sequence=self.first_sequence, recipe=self.recipe)

    @property
    def wants_part(self) -> bool:
        """Whether part number `index` is to be put in now."""
        return self.phase is Phase.EMPTY

    def load(self, serial: str) -> None:
        """The part is in the nest."""
        self.serial = serial
        self.phase = Phase.IDLE

    def scan(self, image: StationImage | None, now_s: float) -> PlcRequest:
        """One scan: what was read of the station (None: nothing), and the registers to write."""
        self._beat(image, now_s)
        if image is not None and now_s - self._heard_at_s <= _LOST_S:
            self._advance(image, now_s)
            self._reset_faults(image, now_s)
        present = Ctrl(0) if self.phase in (Phase.EMPTY, Phase.DONE) else Ctrl.PART_PRESENT
        latch = Ctrl.PART_CHANGED if self.part_changed else Ctrl(0)
        mask = Ctrl.START | Ctrl.RESULT_ACK | Ctrl.RESET_FAULT
        self.out = replace(self.out, ctrl=Ctrl.ENABLE | present | latch | (self.out.ctrl & mask))
        return self.out

    def _advance(self, image: StationImage, now_s: float) -> None:
        if self.phase is Phase.IDLE:
            self._request(image, now_s)
        elif self.phase is Phase.WAIT:
            self._wait(image, now_s)
        elif self.phase is Phase.ACK:
            self._clear(image)

    def _request(self, image: StationImage, now_s: float) -> None:
        """Ask for a verdict on the part; a verdict that stands for somebody else is sent back first."""
        if image.shows(StatusBits.RESULT_VALID):
            self._acknowledge(image.sequence, AckCode.NOT_ROUTED)
        elif image.shows(StatusBits.READY | StatusBits.ONLINE) and now_s >= self._resume_at_s:
            self.part_changed = False
            self._wrong_reads = 0
            self.out = replace(self.out, sequence=self.out.sequence + 1, serial=self.serial)
            self._raise(Ctrl.START)
            self._answered_at_s = now_s
            self.phase = Phase.WAIT

    def _wait(self, image: StationImage, now_s: float) -> None:
        """Take the verdict, or see that none will come: refused, aborted, or forgotten."""
        if image.status & (StatusBits.START_ACK | StatusBits.BUSY):
            self._answered_at_s = now_s
        if image.shows(StatusBits.RESULT_VALID):
            self._judge(image)
        elif image.fault_code or image.shows(StatusBits.ABORTED):
            self._write("refused", fault_code=image.fault_code, status=int(image.status))
            self._give_up(now_s)
        elif now_s - self._answered_at_s > _SILENCE_S:
            self._write("unanswered", status=int(image.status))
            self._give_up(now_s)

    def _judge(self, image: StationImage) -> None:
        if image.sequence != self.out.sequence:
            self._acknowledge(image.sequence, AckCode.NOT_ROUTED)
            return
        try:
            block = decode_result(image.block)
        except BadReply as error:
            self._wrong_reads += 1
            if self._wrong_reads >= _WRONG_READS:
                self._write("rejected", why=error.what)
                self._acknowledge(image.sequence, AckCode.NOT_ROUTED)
            return
        if block.serial != self.serial or self.part_changed:
            self._write("rejected", why="another serial" if block.serial != self.serial else "part changed")
            self._acknowledge(block.sequence, AckCode.NOT_ROUTED)
        else:
            self._route(block, image)

    def _route(self, block: ResultBlock, image: StationImage) -> None:
        self._routed = True
        self._write(
            "verdict",
            verdict=block.verdict.name,
            code=int(block.verdict),
            reason=block.reason,
            record_id=block.record_id,
            worst_deviation_um=block.worst_deviation_um,
            missing_volume_mm3=block.missing_volume_mm3_x1000 / 1000.0,
            defects=block.defects,
            coverage_percent=block.coverage_percent_x100 / 100.0,
            time_ms=block.time_ms,
            station_epoch=image.epoch,
        )
        self._acknowledge(block.sequence, AckCode.ROUTED)

    def _clear(self, image: StationImage) -> None:
        """The verdict is gone from the registers: take the part out, or ask again for the same one."""
        if image.shows(StatusBits.RESULT_VALID) and image.sequence == self.out.ack_sequence:
            return
        self._lower(Ctrl.RESULT_ACK)
        if not self._routed:
            self.phase = Phase.IDLE
            return
        self._routed = False
        self.serial = None
        self.part_changed = True
        self.index += 1
        self.phase = Phase.DONE if self.index == self.parts else Phase.EMPTY

    def _acknowledge(self, sequence: int, code: AckCode) -> None:
        self._lower(Ctrl.START)
        self.out = replace(self.out, ack_sequence=sequence, ack_code=int(code))
        self._raise(Ctrl.RESULT_ACK)
        self.phase = Phase.ACK

    def _give_up(self, now_s: float) -> None:
        self._lower(Ctrl.START)
        self._resume_at_s = now_s + _PAUSE_S
        self.phase = Phase.IDLE

    def _beat(self, image: StationImage | None, now_s: float) -> None:
        if now_s >= self._beaten_at_s + _BEAT_S:
            self.out = replace(self.out, heartbeat=(self.out.heartbeat + 1) & 0xFFFF)
            self._beaten_at_s = now_s
        if image is not None:
            if image.heartbeat != self._heard:
                self._heard, self._heard_at_s = image.heartbeat, now_s
            self.out = replace(self.out, echo_station_heartbeat=image.heartbeat)

    def _reset_faults(self, image: StationImage, now_s: float) -> None:
        """While the station shows FAULT, press reset for the second second of every five."""
        self._lower(Ctrl.RESET_FAULT)
        if not image.shows(StatusBits.FAULT):
            self._faulty_since_s = None
            return
        self._faulty_since_s = now_s if self._faulty_since_s is None else self._faulty_since_s
        if 1.0 <= (now_s - self._faulty_since_s) % _RESET_PERIOD_S < 2.0:
            self._raise(Ctrl.RESET_FAULT)

    def _raise(self, bit: Ctrl) -> None:
        self.out = replace(self.out, ctrl=self.out.ctrl | bit)

    def _lower(self, bit: Ctrl) -> None:
        self.out = replace(self.out, ctrl=self.out.ctrl & ~bit)

    def _write(self, event: str, **facts: object) -> None:
        self.log.append(
            {
                "event": event,
                "index": self.index,
                "serial": self.serial,
                "sequence": self.out.sequence,
                **facts,
            }
        )


async def run_plc(
    program: PlcProgram,
    host: str,
    port: int,
    *,
    load: Callable[[int], Awaitable[str]],
    report: Callable[[Line], None],
) -> None:
    """Run the program against the station at `host:port`, for ever; lost connections are made again.

    `load` puts part number n in and gives its serial; `report` takes each line of the log.
    """
    clock = asyncio.get_running_loop().time
    client = AsyncModbusTcpClient(host, port=port, timeout=_CALL_S, retries=0, reconnect_delay=0)
    loading: asyncio.Task[str] | None = None
    me = asyncio.current_task()
    assert me is not None
    try:
        # The client can swallow a cancellation that comes together with its answer: ask for it.
        while not me.cancelling():
            if program.wants_part and loading is None:
                loading = asyncio.ensure_future(load(program.index))
            if loading is not None and loading.done():
                program.load(loading.result())
                loading = None
            image = await _read(client)
            await _write(client, program.scan(image, clock()))
            while program.log:
                report(program.log.pop(0))
            await asyncio.sleep(_SCAN_S)
    finally:
        client.close()
        if loading is not None:
            loading.cancel()


async def _read(client: AsyncModbusTcpClient) -> StationImage | None:
    """The station's registers in one request; None when they could not be had whole."""
    if not (client.connected or await client.connect()):
        return None
    try:
        answer = await client.read_holding_registers(STATUS, count=STATION_COUNT, device_id=1)
    except ModbusException:
        client.close()
        return None
    # pymodbus would pass another function, count or a zero transaction as right
    sent = client.ctx.next_tid
    if answer.isError() or (answer.function_code, answer.transaction_id) != (3, sent):
        return None
    with suppress(BadReply):
        return decode_image(answer.registers)
    return None


async def _write(client: AsyncModbusTcpClient, request: PlcRequest) -> None:
    """Registers 0-28 in one request; a lost one is made good by the next scan."""
    if not client.connected:
        return
    try:
        answer = await client.write_registers(0, encode_request(request), device_id=1)
    except ModbusException:
        client.close()
        return
    if answer.isError() or (answer.address, answer.count) != (0, REQUEST_COUNT):
        client.close()
