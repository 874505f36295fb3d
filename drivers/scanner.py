"""The scanner: three channels of one device, and a capture that is provably the one asked for.

Modbus tells the sensor's state and the stamp of its last frame, the control channel starts and triggers,
the data channel brings groups. A capture counts only if its index is exactly one more than before the
trigger, its time not before the trigger, its serial the configured one, its group whole, and if Modbus
then agrees.
"""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack
from dataclasses import dataclass
from types import TracebackType
from typing import Self, TypeVar

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ConnectionException, ModbusException

from drivers.errors import BadReply, DeviceFault, LinkDown, Refused, Timeout
from drivers.wire.scanner import (
    CONTROL_CAP,
    PROTOCOL_MAJOR,
    SENSOR_STATE,
    STAMP_BLOCK,
    STAMP_BLOCK_COUNT,
    STATE_BLOCK_COUNT,
    Control,
    FrameSplitter,
    GroupSplitter,
    RangeFrame,
    Status,
    decode_control_reply,
    decode_group,
    decode_stamp_block,
    decode_state_block,
    encode_control,
)

Splitter = FrameSplitter | GroupSplitter
Answer = TypeVar("Answer")

_UNIT = 1
_CONNECT_S = 5.0
_CONNECT_PAUSE_S = 0.1
_REPLY_S = 2.0
_MODBUS_S = 0.5
_AGREE_S = 5.0
_POLL_S = 0.02
_MOST_WAITING = 4  # groups nobody asked for: the oldest go


@dataclass(frozen=True, slots=True, kw_only=True)
class ScannerStatus:
    """What Modbus says: whether the sensor runs, its clock, and the stamp of its last frame."""

    running: bool
    time_us: int
    frame_index: int
    timestamp_us: int


class Channel(asyncio.Protocol):
    """One TCP channel of the sensor: whole frames or groups in, and why no more will come."""

    def __init__(self, port: str, splitter: Splitter) -> None:
        self.port = port
        self.frames: deque[bytes] = deque(maxlen=_MOST_WAITING)
        self._splitter = splitter
        self._changed = asyncio.Event()
        self._failure: LinkDown | BadReply | None = None
        self._transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        try:
            self.frames.extend(self._splitter.feed(data))
        except BadReply as error:
            self._failure = error.at(self.port)
            self.close()
        self._changed.set()

    def connection_lost(self, exc: Exception | None) -> None:
        why = str(exc) if exc else "the connection was closed"
        self._failure = self._failure or LinkDown("scanner", self.port, why)
        self._changed.set()

    def send(self, data: bytes) -> None:
        """Write; raises `LinkDown` on a closed channel."""
        if self._failure is not None:
            raise self._failure
        assert self._transport is not None
        self._transport.write(data)

    async def receive(self, timeout_s: float, what: str) -> bytes:
        """The oldest whole frame; raises `Timeout` naming `what` was awaited."""
        try:
            async with asyncio.timeout(timeout_s):
                while not self.frames:
                    if self._failure is not None:
                        raise self._failure
                    self._changed.clear()
                    await self._changed.wait()
        except TimeoutError:
            raise Timeout("scanner", self.port, f"no {what} within {timeout_s:g} s") from None
        return self.frames.popleft()

    def close(self) -> None:
        """Drop the connection."""
        if self._transport is not None:
            self._transport.abort()


class Scanner:
    """One snapshot sensor in software-trigger mode, as an async context manager."""

    def __init__(
        self,
        *,
        host: str,
        modbus_port: int = 502,
        control_port: int = 3190,
        data_port: int = 3196,
        serial: int,
        capture_timeout_s: float = 30.0,
    ) -> None:
        self.host = host
        self.serial = serial
        self._ports = (modbus_port, control_port, data_port)
        self._capture_timeout_s = capture_timeout_s
        self._lock = asyncio.Lock()
        self._stack = AsyncExitStack()
        self._modbus: AsyncModbusTcpClient
        self._control: Channel
        self._data: Channel

    async def __aenter__(self) -> Self:
        modbus_port, control_port, data_port = self._ports
        async with AsyncExitStack() as stack:
            self._modbus = await self._open_modbus(modbus_port)
            stack.callback(self._modbus.close)
            self._control = await self._open_channel(control_port, FrameSplitter(CONTROL_CAP))
            stack.callback(self._control.close)
            self._data = await self._open_channel(data_port, GroupSplitter())
            stack.callback(self._data.close)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._stack.aclose()

    async def prepare(self) -> None:
        """Check the protocol version and see that the sensor runs; safe to repeat."""
        version = await self._command(Control.PROTOCOL_VERSION)
        if version[:1] != bytes([PROTOCOL_MAJOR]):
            raise BadReply("scanner", self._control.port, f"protocol version {version[:2]!r}, want 101")
        if not (await self.status()).running:
            await self._command(Control.START)
            await self._until(lambda status: status.running, "running state")

    async def status(self) -> ScannerStatus:
        """State and last stamp, by Modbus."""
        state = decode_state_block(await self._read(SENSOR_STATE, STATE_BLOCK_COUNT))
        stamp = decode_stamp_block(await self._read(STAMP_BLOCK, STAMP_BLOCK_COUNT))
        return ScannerStatus(
            running=state.running,
            time_us=state.time_us,
            frame_index=stamp.frame_index,
            timestamp_us=stamp.timestamp_us,
        )

    async def capture(self) -> RangeFrame:
        """The frame of one trigger; a trigger that provably took no frame is sent once more.

        Raises `Timeout` when no frame came, `BadReply` for one that is not the frame asked for, `Refused`
        when the sensor does not take the trigger, `LinkDown` when a channel is gone.
        """
        async with self._lock:
            self._data.frames.clear()
            before = await self.status()
            if not before.running:
                raise DeviceFault("scanner", self.host, "is stopped")
            try:
                frame = await self._trigger(before)
            except Timeout:
                if (await self.status()).frame_index != before.frame_index:
                    raise
                frame = await self._trigger(before)
            await self._until(lambda status: status.frame_index == frame.frame_index, "agreement by Modbus")
            return frame

    async def _trigger(self, before: ScannerStatus) -> RangeFrame:
        """The frame of a trigger sent now. Frames that are older by index or by time are passed over."""
        await self._command(Control.TRIGGER)
        clock = asyncio.get_running_loop().time
        deadline = clock() + self._capture_timeout_s
        last = before.frame_index
        while True:
            raw = await self._data.receive(max(deadline - clock(), 0.0), "frame")
            frame = await asyncio.to_thread(self._decode, raw)
            if frame.frame_index > before.frame_index:
                self._check(frame, last)
                if frame.timestamp_us >= before.time_us and frame.timestamp_us > before.timestamp_us:
                    return frame
                last = frame.frame_index

    def _decode(self, raw: bytes) -> RangeFrame:
        try:
            return decode_group(raw)
        except BadReply as error:
            raise error.at(self._data.port) from None

    def _check(self, frame: RangeFrame, last: int) -> None:
        """Raise `BadReply` unless the frame is of this scanner and the next after frame `last`."""
        if frame.scanner_serial != self.serial:
            what = f"frame of scanner {frame.scanner_serial}, want {self.serial}"
            raise BadReply("scanner", self._data.port, what)
        if frame.frame_index != last + 1:
            raise BadReply("scanner", self._data.port, f"frame {frame.frame_index}, want {last + 1}")

    async def _command(self, command: Control) -> bytes:
        """The payload of an accepted command; silence closes the channel, for replies carry no id."""
        self._control.frames.clear()
        self._control.send(encode_control(command))
        try:
            frame = await self._control.receive(_REPLY_S, f"reply to {command.name}")
        except (Timeout, asyncio.CancelledError):
            self._control.close()
            raise
        try:
            reply = decode_control_reply(frame)
        except BadReply as error:
            self._control.close()
            raise error.at(self._control.port) from None
        if reply.command != command:
            self._control.close()
            raise BadReply("scanner", self._control.port, f"{reply.command:#06x} answers {command:#06x}")
        if reply.status != Status.OK:
            raise Refused("scanner", self._control.port, f"{command.name} refused, status {reply.status}")
        return reply.payload

    async def _until(self, holds: Callable[[ScannerStatus], bool], what: str) -> None:
        clock = asyncio.get_running_loop().time
        deadline = clock() + _AGREE_S
        while not holds(await self.status()):
            if not clock() <= deadline:
                raise BadReply("scanner", self.host, f"no {what} within {_AGREE_S:g} s")
            await asyncio.sleep(_POLL_S)

    async def _read(self, address: int, count: int) -> list[int]:
        """Holding registers; after silence or a contradiction once more, on a new connection."""
        try:
            return await self._read_once(address, count)
        except (Timeout, BadReply):
            self._modbus.close()
        try:
            return await self._read_once(address, count)
        except (Timeout, BadReply):
            self._modbus.close()
            raise

    async def _read_once(self, address: int, count: int) -> list[int]:
        """Holding registers, believed only if unit, transaction, function and count are those of the request.

        pymodbus lets through an answer with transaction 0, another function code or another count.
        """
        port, what = f"{self.host}:{self._ports[0]}", f"registers {address}+{count}"
        if not (self._modbus.connected or await _heeding(self._modbus.connect())):
            raise LinkDown("scanner", port, f"{what}: not connected")
        try:
            answer = await _heeding(
                self._modbus.read_holding_registers(address, count=count, device_id=_UNIT)
            )
        except ConnectionException as error:
            raise LinkDown("scanner", port, f"{what}: not connected") from error
        except ModbusException as error:
            raise Timeout("scanner", port, f"{what}: no right answer within {_MODBUS_S:g} s") from error
        if answer.isError():
            raise Refused("scanner", port, f"{what}: exception {answer.exception_code}")
        got = (answer.function_code, answer.dev_id, answer.transaction_id, len(answer.registers))
        if got != (3, _UNIT, self._modbus.ctx.next_tid, count):
            raise BadReply("scanner", port, f"{what}: the answer has function, unit, id, count {got}")
        return list(answer.registers)

    async def _open_modbus(self, port: int) -> AsyncModbusTcpClient:
        """A connected client; the first connection is our own loop, for pymodbus does not repeat it."""
        client = AsyncModbusTcpClient(self.host, port=port, timeout=_MODBUS_S, retries=0, reconnect_delay=0)
        clock = asyncio.get_running_loop().time
        deadline = clock() + _CONNECT_S
        while not await _heeding(client.connect()):
            if clock() > deadline:
                client.close()
                raise LinkDown("scanner", f"{self.host}:{port}", "no Modbus connection")
            await asyncio.sleep(_CONNECT_PAUSE_S)
        return client

    async def _open_channel(self, port: int, splitter: Splitter) -> Channel:
        where = f"{self.host}:{port}"
        try:
            async with asyncio.timeout(_CONNECT_S):
                _, channel = await asyncio.get_running_loop().create_connection(
                    lambda: Channel(where, splitter), self.host, port
                )
        except (OSError, TimeoutError) as error:
            raise LinkDown("scanner", where, f"no connection: {error}") from error
        return channel


async def _heeding(call: Awaitable[Answer]) -> Answer:
    """The result of a pymodbus call; raises the cancellation that came together with it.

    pymodbus waits with `asyncio.wait_for`, which in Python 3.11 drops a cancellation that meets the answer.
    """
    task = asyncio.current_task()
    assert task is not None
    cancellations = task.cancelling()
    try:
        return await call
    finally:
        if task.cancelling() > cancellations:
            raise asyncio.CancelledError
