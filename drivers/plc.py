"""The station's side of the PLC handshake: a Modbus TCP server whose registers the PLC polls.

Only words pass here, no decisions. The registers are one list that the server's action reads and writes,
so that `publish` is one synchronous step: no request can see half of it. The PLC may write 0-28 and
nothing else.
"""

import asyncio
import logging
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import cast

from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from drivers.errors import LinkDown
from drivers.wire.plc import (
    FAULT_CODE,
    PATTERN,
    PATTERN_VALUES,
    REASON,
    REGISTER_COUNT,
    REQUEST_COUNT,
    RESULT,
    RESULT_COUNT,
    STATE,
    STATION_EPOCH,
    STATION_HEARTBEAT,
    STATUS,
    FaultCode,
    PlcRequest,
    ResultBlock,
    StatusBits,
    decode_request,
)

# pymodbus logs whole frames at ERROR; on a screen that is ruin. Who wants them adds a handler here.
logging.getLogger("pymodbus.logging").addHandler(logging.NullHandler())
logging.getLogger("pymodbus.logging").propagate = False

_BEAT_S = 0.5
_GOOD_BEATS = 3
_READS, _WRITES = (3, 4), (6, 16)


@dataclass(slots=True)
class HeartbeatWatch:
    """Whether a counter still advances: three advances make it alive, one timeout makes it lost."""

    timeout_s: float
    _last: int | None = None
    _advanced_at_s: float = float("-inf")
    _good: int = 0

    def see(self, counter: int, now_s: float) -> None:
        """Take a reading of the counter."""
        if now_s - self._advanced_at_s > self.timeout_s:
            self._good = 0
        if self._last is not None and counter != self._last:
            self._good = min(self._good + 1, _GOOD_BEATS)
            self._advanced_at_s = now_s
        self._last = counter

    def alive(self, now_s: float) -> bool:
        """Whether the counter has advanced often enough, and lately enough."""
        return self._good >= _GOOD_BEATS and now_s - self._advanced_at_s <= self.timeout_s


@dataclass(slots=True, kw_only=True)
class PlcLink:
    """The registers between PLC and station, as the station sees them."""

    host: str
    port: int
    epoch: int
    watch: HeartbeatWatch
    foreign_writes: int = 0  # refused writes outside 0-28
    _registers: list[int] = field(default_factory=lambda: [0] * REGISTER_COUNT)
    _changed: asyncio.Event = field(default_factory=asyncio.Event)
    _next_beat_s: float = float("-inf")

    def __post_init__(self) -> None:
        self._registers[STATION_EPOCH] = self.epoch & 0xFFFF
        self._registers[PATTERN : PATTERN + len(PATTERN_VALUES)] = PATTERN_VALUES

    @classmethod
    @asynccontextmanager
    async def open(
        cls, host: str, port: int, *, epoch: int = 1, heartbeat_timeout_s: float = 2.0
    ) -> AsyncIterator["PlcLink"]:
        """A link that listens until the block ends; raises `LinkDown` if the port is taken.

        `port` 0 takes a free one. `epoch` is the station's count of starts.
        """
        link = cls(host=host, port=port, epoch=epoch, watch=HeartbeatWatch(heartbeat_timeout_s))
        _check_port(host, port)
        server = ModbusTcpServer(link._device(), address=(host, port))
        try:
            await server.serve_forever(background=True)
        except RuntimeError as error:
            raise LinkDown("plc", f"{host}:{port}", f"cannot listen: {error}") from error
        link.port = cast(asyncio.Server, server.transport).sockets[0].getsockname()[1]
        try:
            yield link
        finally:
            await server.shutdown()  # type: ignore[no-untyped-call]

    def request(self) -> PlcRequest:
        """What the PLC has written, as of now."""
        return decode_request(self._registers[:REQUEST_COUNT])

    async def wait_change(self, timeout_s: float) -> bool:
        """Whether the PLC changed a register since the last call, waiting for it up to `timeout_s`."""
        try:
            async with asyncio.timeout(timeout_s):
                await self._changed.wait()
        except TimeoutError:
            return False
        self._changed.clear()
        return True

    @property
    def status(self) -> StatusBits:
        """Register 100 as the PLC sees it."""
        return StatusBits(self._registers[STATUS])

    @property
    def heartbeat(self) -> int:
        """Register 101 as the PLC sees it."""
        return self._registers[STATION_HEARTBEAT]

    def set_status(self, bits: StatusBits) -> None:
        """Write register 100."""
        self._registers[STATUS] = int(bits)

    def set_state(self, packml: int) -> None:
        """Write register 103."""
        self._registers[STATE] = packml & 0xFFFF

    def publish(self, block: ResultBlock, status: StatusBits) -> None:
        """Write 104-139, then the status that declares them valid, in one step."""
        self._registers[RESULT : RESULT + RESULT_COUNT] = block.encode()
        self.set_status(status)

    def refuse(self, fault: FaultCode, reason: int, status: StatusBits) -> None:
        """Show why a request is not taken: 104-139 zero but for the reason and the fault code."""
        self.clear_result()
        self._registers[REASON], self._registers[FAULT_CODE] = reason & 0xFFFF, int(fault)
        self.set_status(status)

    def clear_result(self) -> None:
        """Write zeros to 104-139."""
        self._registers[RESULT : RESULT + RESULT_COUNT] = [0] * RESULT_COUNT

    def beat(self, now_s: float) -> None:
        """Read the PLC's heartbeat and advance the station's every 0.5 s; call it more often than that."""
        self.watch.see(self._registers[1], now_s)
        if now_s >= self._next_beat_s:
            self._registers[STATION_HEARTBEAT] = (self.heartbeat + 1) & 0xFFFF
            self._next_beat_s = now_s + _BEAT_S

    def plc_alive(self, now_s: float) -> bool:
        """Whether the PLC's heartbeat has advanced three times, and within the timeout."""
        return self.watch.alive(now_s)

    def _device(self) -> SimDevice:
        """The Modbus device: id 0 answers every unit id, for gateways send 0, 1 or 255."""
        blank = SimData(0, count=REGISTER_COUNT, values=0, datatype=DataType.REGISTERS)
        return SimDevice(id=0, simdata=[blank], action=self._serve)

    async def _serve(
        self,
        function: int,
        start: int,
        address: int,
        count: int,
        current: list[int],
        values: list[int] | list[bool] | None,
    ) -> ExcCodes | None:
        """Answer one request from our registers: pymodbus asks before it touches its own copy."""
        if function not in _READS + _WRITES:
            return ExcCodes.ILLEGAL_FUNCTION
        if values is not None and address + count > REQUEST_COUNT:
            self.foreign_writes += 1
            return ExcCodes.ILLEGAL_ADDRESS
        wanted = slice(address, address + count)
        if values is None:
            current[wanted.start - start : wanted.stop - start] = self._registers[wanted]
        elif self._registers[wanted] != values:
            self._registers[wanted] = [int(value) for value in values]
            self._changed.set()
        return None


def _check_port(host: str, port: int) -> None:
    """Raise `LinkDown` with the system's own reason if `port` cannot be listened on."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
            probe.listen()
    except OSError as error:
        raise LinkDown("plc", f"{host}:{port}", f"cannot listen: {error.strerror or error}") from error
