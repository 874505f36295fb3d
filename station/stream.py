"""The event stream: JSON lines over loopback TCP. A snapshot first, then what happens; intents come back.

Emitting never waits: a line goes into the socket's buffer, and a client that lets it grow beyond
`MAX_BACKLOG_BYTES` is dropped. Screens come, die and come back; the cell does not notice.
"""

import asyncio
import contextlib
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

from station.events import (
    AlarmCleared,
    AlarmRaised,
    BadEvent,
    CloudMeasured,
    DeviceStatus,
    Event,
    Intent,
    LogLine,
    PartRecorded,
    PartStarted,
    SectionMeasured,
    SnapshotEnd,
    StepFinished,
    StepStarted,
    VerdictAcknowledged,
    VerdictReached,
    ViewCaptured,
    decode_intent,
    encode,
)

MAX_BACKLOG_BYTES = 16 << 20
MAX_CLIENTS = 8
MAX_INTENT_BYTES = 4096
KEPT_PARTS = 20
KEPT_LOG_LINES = 50

_OF_ONE_PART = (
    PartStarted,
    StepStarted,
    StepFinished,
    ViewCaptured,
    CloudMeasured,
    SectionMeasured,
    VerdictReached,
    VerdictAcknowledged,
)


@dataclass(slots=True)
class Memory:
    """The lines that tell a newcomer the present state, in the order in which they happened."""

    lines: dict[Hashable, bytes] = field(default_factory=dict)
    _logged: int = 0

    def keep(self, event: Event, line: bytes) -> None:
        """Remembers an event in place of those that it makes old."""
        if isinstance(event, PartStarted):
            self._forget(lambda key: key[0] in _OF_ONE_PART)
        key = self._key(event)
        self.lines.pop(key, None)
        if not isinstance(event, AlarmCleared):
            self.lines[key] = line
        self._cap(PartRecorded, KEPT_PARTS)
        self._cap(LogLine, KEPT_LOG_LINES)

    def _key(self, event: Event) -> tuple[type, Hashable]:
        match event:
            case DeviceStatus(device=device):
                return DeviceStatus, device
            case AlarmRaised(number=number) | AlarmCleared(number=number):
                return AlarmRaised, number
            case PartRecorded(record_no=number):
                return PartRecorded, number
            case ViewCaptured(index=index):
                return ViewCaptured, index
            case SectionMeasured(z_mm=z_mm):
                return SectionMeasured, z_mm
            case StepStarted(step=step) | StepFinished(step=step):
                return type(event), step
            case LogLine():
                self._logged += 1
                return LogLine, self._logged
        return type(event), None

    def _forget(self, old: Callable[[tuple[type, Hashable]], bool]) -> None:
        for key in [key for key in self.lines if isinstance(key, tuple) and old(key)]:
            del self.lines[key]

    def _cap(self, kind: type, most: int) -> None:
        keys = [key for key in self.lines if isinstance(key, tuple) and key[0] is kind]
        for key in keys[: len(keys) - most if len(keys) > most else 0]:
            del self.lines[key]

    def snapshot(self) -> Iterator[bytes]:
        """The lines for a newcomer."""
        yield from self.lines.values()
        yield encode(SnapshotEnd())


class EventStream:
    """The server, as an async context manager. `on_intent` hears good intents, `on_event` every event."""

    def __init__(
        self,
        host: str,
        port: int,
        on_intent: Callable[[Intent], None],
        on_event: Callable[[Event], None] = lambda event: None,
    ) -> None:
        self.host, self.port = host, port
        self._on_intent = on_intent
        self._on_event = on_event
        self._memory = Memory()
        self._clients: set[asyncio.StreamWriter] = set()
        self._server: asyncio.Server | None = None
        self.bad_lines = 0

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(
            self._serve, self.host, self.port, limit=MAX_INTENT_BYTES, reuse_address=True
        )
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._server is not None:
            self._server.close()
        for client in self._clients.copy():
            self._drop(client)

    def emit(self, event: Event) -> None:
        """Tells every client; returns at once."""
        line = encode(event)
        self._memory.keep(event, line)
        self._on_event(event)
        for client in self._clients.copy():
            self._send(client, line)

    def _send(self, client: asyncio.StreamWriter, line: bytes) -> None:
        client.write(line)
        if client.transport.get_write_buffer_size() > MAX_BACKLOG_BYTES:
            self._drop(client)

    def _drop(self, client: asyncio.StreamWriter) -> None:
        self._clients.discard(client)
        client.transport.abort()

    async def _serve(self, reader: asyncio.StreamReader, client: asyncio.StreamWriter) -> None:
        if len(self._clients) >= MAX_CLIENTS:
            client.transport.abort()
            return
        for line in self._memory.snapshot():
            client.write(line)
        self._clients.add(client)
        # Lines over the limit are a ValueError; a reset connection ends the client as silently as its end.
        with contextlib.suppress(OSError, ValueError):
            while line := await reader.readline():
                self._take(line)
        self._drop(client)

    def _take(self, line: bytes) -> None:
        intent = decode_intent(line)
        if isinstance(intent, BadEvent):
            self.bad_lines += 1
        else:
            self._on_intent(intent)
