"""A snapshot sensor that speaks Gocator's three channels.

`ScannerDevice` is the sensor's state and its answers, without clock or socket. `serve_scanner` puts it on
the wire: Modbus, control and data, any number of clients on each.
"""

import asyncio
import logging
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import cast

from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from drivers.wire.errors import BadReply
from drivers.wire.scanner import (
    COMMAND,
    COMMAND_COUNT,
    CONTROL_CAP,
    FRAME_INDEX,
    FRAME_TIME,
    PROTOCOL_MAJOR,
    READABLE,
    SENSOR_STATE,
    TIME_NOW,
    Control,
    ControlReply,
    FrameSplitter,
    Stamp,
    Status,
    decode_control,
    encode_control_reply,
    registers_of,
)
from simulators.faults import Faults
from simulators.serve import HangUp, Silent, TcpServer, serve_tcp

logging.getLogger("pymodbus.logging").addHandler(logging.NullHandler())
logging.getLogger("pymodbus.logging").propagate = False

SERIAL = 93111
_PROTOCOL_MINOR = 4
_REGISTER_COUNT = 1060
_NO_MEASUREMENT = (0x8000, 0x0000, 0b10)  # invalid value, decision "invalid value"

Expose = Callable[[], Awaitable[Callable[[Stamp], bytes]]]


@dataclass(slots=True, kw_only=True)
class ScannerDevice:
    """The sensor: running or not, the triggers it has yet to serve, and the stamp of its last frame."""

    serial: int = SERIAL
    running: bool = False
    pending: int = 0
    frame_index: int = 0
    frame_time_us: int = 0
    lose_triggers: int = 0  # the next so many are accepted and then forgotten

    def trigger(self) -> Status:
        """Whether a trigger is taken: only while running; one that comes during an exposure waits for it."""
        if not self.running:
            return Status.INVALID_STATE
        if self.lose_triggers > 0:
            self.lose_triggers -= 1
        else:
            self.pending += 1
        return Status.OK

    def next_stamp(self, exposed_at_s: float) -> Stamp:
        """The stamp of the frame that is ready now; time goes up even on a clock that stands."""
        self.frame_index += 1
        self.frame_time_us = max(round(exposed_at_s * 1e6), self.frame_time_us + 1)
        return Stamp(
            frame_index=self.frame_index, timestamp_us=self.frame_time_us, scanner_serial=self.serial
        )

    def control(self, frame: bytes, now_s: float) -> ControlReply:
        """The reply to a frame of the control channel."""
        command, _ = decode_control(frame)
        status, payload = Status.OK, b""
        if command == Control.PROTOCOL_VERSION:
            payload = bytes([PROTOCOL_MAJOR, _PROTOCOL_MINOR])
        elif command == Control.STATES:
            payload = self._states(now_s)
        elif command in (Control.START, Control.STOP):
            self.running = command == Control.START
        elif command == Control.TRIGGER:
            status = self.trigger()
        elif command == Control.TIMESTAMP:
            payload = round(now_s * 1e6).to_bytes(8, "little")
        elif command != Control.PING:
            status = Status.INVALID_COMMAND
        return ControlReply(command=command, status=status, payload=payload)

    def read(self, address: int, count: int, now_s: float) -> list[int] | None:
        """Registers as a master reads them; None outside the map, and for the write-only commands."""
        if not all(any(at in block for block in READABLE) for at in range(address, address + count)):
            return None
        return self._registers(now_s)[address : address + count]

    def write(self, address: int, values: list[int]) -> bool:
        """Take a write; False outside the map. Register 0: 0 stops, 1 starts, 2-6 have nothing to do."""
        if address + len(values) > COMMAND + COMMAND_COUNT or (address == COMMAND and values[0] > 6):
            return False
        if address == COMMAND and values[0] in (0, 1):
            self.running = values[0] == 1
        return True

    def _states(self, now_s: float) -> bytes:
        states = [int(self.running), 0, 0, 0, 0, 0, int(now_s), int(now_s % 1.0 * 1e6), 0, 0, 0]
        return b"".join(value.to_bytes(4, "little") for value in [len(states), *states])

    def _registers(self, now_s: float) -> list[int]:
        registers = [0] * _REGISTER_COUNT
        registers[SENSOR_STATE] = int(self.running)
        registers[TIME_NOW : TIME_NOW + 4] = registers_of(round(now_s * 1e6), 4)
        registers[FRAME_TIME : FRAME_TIME + 4] = registers_of(self.frame_time_us, 4)
        registers[FRAME_INDEX : FRAME_INDEX + 4] = registers_of(self.frame_index, 4)
        registers[1000:1060] = _NO_MEASUREMENT * 20
        return registers


@dataclass(slots=True, kw_only=True)
class ScannerPorts:
    """Where the three channels listen."""

    modbus: int
    control: int
    data: int


@dataclass(slots=True, kw_only=True)
class _Wire:
    """The device among its servers."""

    device: ScannerDevice
    expose: Expose
    clock: Callable[[], float]
    data: TcpServer | None = None
    exposing: asyncio.Task[None] | None = None

    def serve_triggers(self) -> None:
        """See that somebody takes the pictures that are due."""
        if self.device.pending and self.exposing is None:
            self.exposing = asyncio.get_running_loop().create_task(self._expose())

    async def _expose(self) -> None:
        while self.device.pending:
            began_s = self.clock()
            try:
                group_of = await self.expose()
            except Exception as error:  # whatever fails behind the optics, the sensor stays on the wire
                sys.stderr.write(f"scanner: the exposure failed: {error!r}\n")
            else:
                assert self.data is not None
                self.data.broadcast(group_of(self.device.next_stamp(began_s)))
            self.device.pending -= 1
        self.exposing = None

    async def modbus(
        self,
        function: int,
        start: int,
        address: int,
        count: int,
        current: list[int],
        values: list[int] | list[bool] | None,
    ) -> ExcCodes | None:
        if function not in (3, 4, 6, 16):
            return ExcCodes.ILLEGAL_FUNCTION
        if values is not None:
            taken = self.device.write(address, [int(value) for value in values])
            return None if taken else ExcCodes.ILLEGAL_ADDRESS
        if function == 6:
            return None  # pymodbus reads back what it has just written
        registers = self.device.read(address, count, self.clock())
        if registers is None:
            return ExcCodes.ILLEGAL_ADDRESS
        current[address - start : address - start + count] = registers
        return None


class _ControlSession:
    def __init__(self, wire: _Wire) -> None:
        self._wire = wire
        self._frames = FrameSplitter(CONTROL_CAP)

    def feed(self, data: bytes) -> list[bytes]:
        try:
            frames = self._frames.feed(data)
        except BadReply as error:
            raise HangUp(str(error)) from error
        return [self._answer(frame) for frame in frames]

    def _answer(self, frame: bytes) -> bytes:
        reply = self._wire.device.control(frame, self._wire.clock())
        self._wire.serve_triggers()
        return encode_control_reply(reply)


@asynccontextmanager
async def serve_scanner(
    device: ScannerDevice,
    expose: Expose,
    *,
    host: str = "127.0.0.1",
    ports: ScannerPorts,
    clock: Callable[[], float],
    data_faults: Faults | None = None,
) -> AsyncIterator[ScannerPorts]:
    """The device on the wire until the block ends; gives the ports, for 0 stands for a free one.

    `expose` takes the picture and gives what turns a stamp into the bytes of a group.
    """
    wire = _Wire(device=device, expose=expose, clock=clock)
    async with AsyncExitStack() as stack:
        wire.data = await stack.enter_async_context(serve_tcp(host, ports.data, Silent, data_faults))
        control = await stack.enter_async_context(
            serve_tcp(host, ports.control, lambda: _ControlSession(wire))
        )
        modbus = await stack.enter_async_context(_serve_modbus(wire, host, ports.modbus))
        try:
            yield ScannerPorts(modbus=modbus, control=control.port, data=wire.data.port)
        finally:
            if wire.exposing is not None:
                wire.exposing.cancel()


@asynccontextmanager
async def _serve_modbus(wire: _Wire, host: str, port: int) -> AsyncIterator[int]:
    blank = SimData(0, count=_REGISTER_COUNT, values=0, datatype=DataType.REGISTERS)
    server = ModbusTcpServer(SimDevice(id=0, simdata=[blank], action=wire.modbus), address=(host, port))
    await server.serve_forever(background=True)
    try:
        yield cast(asyncio.Server, server.transport).sockets[0].getsockname()[1]
    finally:
        await server.shutdown()  # type: ignore[no-untyped-call]
