"""One asynchronous byte line to an ASCII device: a serial port, a pty or TCP.

Only whole lines come out, each by a deadline. pyserial configures the port and takes its lock
(`exclusive=True` is flock: it keeps a second station out, not a program that asks for no lock);
reading and writing go through the event loop on the bare descriptor, because pyserial hands out what
it has when a timeout strikes and calls it a line.
"""

import asyncio
import os
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import serial

from drivers.errors import BadReply, LinkDown, Timeout
from drivers.wire.lines import LineSplitter

Trace = Callable[[bool, bytes], None]  # (True for sent, the bytes)

_LONGEST_LINE = 256
_MOST_WAITING = 64  # lines nobody asked for: the oldest go
_WRITE_RETRY_S = 0.002


def ignore_bytes(_sent: bool, _data: bytes) -> None:
    """The trace of a line that nobody watches."""


@dataclass(slots=True, kw_only=True)
class Inbox:
    """Lines that arrived, and why no more will."""

    device: str
    port: str
    trace: Trace = ignore_bytes
    splitter: LineSplitter = field(default_factory=lambda: LineSplitter(_LONGEST_LINE))
    lines: deque[bytes] = field(default_factory=lambda: deque(maxlen=_MOST_WAITING))
    changed: asyncio.Event = field(default_factory=asyncio.Event)
    down: LinkDown | None = None

    def feed(self, data: bytes) -> None:
        """Take what the wire brought."""
        self.trace(False, data)
        self.lines.extend(self.splitter.feed(data))
        self.changed.set()

    def hang_up(self, why: str) -> None:
        """Note that the link is gone."""
        self.down = self.down or LinkDown(self.device, self.port, why)
        self.changed.set()

    async def next_line(self, timeout_s: float) -> bytes:
        """The oldest whole line; raises `Timeout`, `LinkDown` or, after an endless line, `BadReply`."""
        try:
            async with asyncio.timeout(timeout_s):
                while not self.lines:
                    self._check()
                    self.changed.clear()
                    await self.changed.wait()
        except TimeoutError:
            raise Timeout(self.device, self.port, f"no line within {timeout_s:g} s") from None
        return self.lines.popleft()

    def _check(self) -> None:
        if self.down is not None:
            raise self.down
        if self.splitter.dropped:
            self.splitter.dropped = 0
            raise BadReply(self.device, self.port, f"a line of more than {_LONGEST_LINE} bytes")


class SerialLine:
    """A serial port or pty, read and written through the event loop."""

    def __init__(self, port: serial.Serial, inbox: Inbox) -> None:
        self.inbox = inbox
        self._port = port
        self._fd: int = port.fileno()
        os.set_blocking(self._fd, False)
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._fd, self._read)

    def _read(self) -> None:
        try:
            data = os.read(self._fd, 4096)
        except BlockingIOError:
            return
        except OSError as error:
            self._lose(os.strerror(error.errno or 0))
            return
        if data:
            self.inbox.feed(data)
        else:
            self._lose("the port hung up")

    async def send(self, data: bytes, timeout_s: float) -> None:
        """Write all of `data`; raises `Timeout` if the far end takes no more, `LinkDown` if it is gone."""
        if self.inbox.down is not None:
            raise self.inbox.down
        self.inbox.trace(True, data)
        try:
            async with asyncio.timeout(timeout_s):
                while data:
                    data = data[self._write(data) :]
                    if data:
                        await asyncio.sleep(_WRITE_RETRY_S)
        except TimeoutError:
            what = f"{len(data)} bytes not taken within {timeout_s:g} s"
            raise Timeout(self.inbox.device, self.inbox.port, what) from None

    def _write(self, data: bytes) -> int:
        try:
            return os.write(self._fd, data)
        except BlockingIOError:
            return 0
        except OSError as error:
            self._lose(os.strerror(error.errno or 0))
            raise LinkDown(self.inbox.device, self.inbox.port, "the port hung up") from error

    def _lose(self, why: str) -> None:
        self._loop.remove_reader(self._fd)
        self.inbox.hang_up(why)

    def close(self) -> None:
        """Give the port back."""
        self._loop.remove_reader(self._fd)
        self._port.close()


class TcpLine(asyncio.Protocol):
    """The same over TCP."""

    def __init__(self, inbox: Inbox) -> None:
        self.inbox = inbox
        self._transport: asyncio.Transport | None = None
        self._writable = asyncio.Event()
        self._writable.set()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport

    def data_received(self, data: bytes) -> None:
        self.inbox.feed(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self.inbox.hang_up(str(exc) if exc else "the connection was closed")
        self._writable.set()

    def pause_writing(self) -> None:
        self._writable.clear()

    def resume_writing(self) -> None:
        self._writable.set()

    async def send(self, data: bytes, timeout_s: float) -> None:
        """Write all of `data`; raises `Timeout` if the far end takes no more, `LinkDown` if it is gone."""
        try:
            async with asyncio.timeout(timeout_s):
                await self._writable.wait()
        except TimeoutError:
            what = f"nothing taken for {timeout_s:g} s"
            raise Timeout(self.inbox.device, self.inbox.port, what) from None
        if self.inbox.down is not None or self._transport is None:
            raise self.inbox.down or LinkDown(self.inbox.device, self.inbox.port, "not connected")
        self.inbox.trace(True, data)
        self._transport.write(data)

    def close(self) -> None:
        """Close the connection."""
        if self._transport is not None:
            self._transport.abort()


Line = SerialLine | TcpLine


async def open_line(
    device: str, port: str, *, baud: int, timeout_s: float, trace: Trace | None = None
) -> Line:
    """The line to `port`: "socket://HOST:PORT", or a serial device; raises `LinkDown` if it does not open."""
    inbox = Inbox(device=device, port=port, trace=trace or ignore_bytes)
    try:
        if port.startswith("socket://"):
            return await _open_tcp(inbox, port.removeprefix("socket://"), timeout_s)
        return SerialLine(await asyncio.to_thread(_open_serial, port, baud), inbox)
    except TimeoutError:
        raise LinkDown(device, port, f"no connection within {timeout_s:g} s") from None
    except (OSError, ValueError) as error:  # serial.SerialException is an OSError
        raise LinkDown(device, port, f"does not open: {error}") from error


async def _open_tcp(inbox: Inbox, address: str, timeout_s: float) -> TcpLine:
    host, _, number = address.rpartition(":")
    async with asyncio.timeout(timeout_s):
        _, line = await asyncio.get_running_loop().create_connection(
            lambda: TcpLine(inbox), host, int(number)
        )
    return line


def _open_serial(port: str, baud: int) -> serial.Serial:
    return serial.Serial(port, baud, timeout=0, exclusive=True)
