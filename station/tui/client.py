"""The screen's end of the station's event stream: events in, intents out, reconnecting by itself."""

import asyncio
from collections.abc import Callable
from contextlib import suppress

from station.events import MAX_LINE_BYTES, BadEvent, Event, Intent, decode, encode

RETRY_S = 1.0
CONNECT_TIMEOUT_S = 3.0


class StreamClient:
    """Follows one station. `on_event` gets each event, `on_lost` the end of a connection."""

    def __init__(
        self, host: str, port: int, on_event: Callable[[Event], None], on_lost: Callable[[], None]
    ) -> None:
        self._host, self._port = host, port
        self._on_event, self._on_lost = on_event, on_lost
        self._writer: asyncio.StreamWriter | None = None

    async def follow(self) -> None:
        """Until cancelled: connect, hand on every event, and start again when the line is lost."""
        while True:
            with suppress(OSError, TimeoutError, ValueError):
                await self._follow_once()
            self._on_lost()
            await asyncio.sleep(RETRY_S)

    async def _follow_once(self) -> None:
        async with asyncio.timeout(CONNECT_TIMEOUT_S):
            reader, writer = await asyncio.open_connection(self._host, self._port, limit=MAX_LINE_BYTES)
        self._writer = writer
        try:
            while line := await reader.readline():
                event = decode(line)
                if not isinstance(event, BadEvent):
                    self._on_event(event)
        finally:
            self._writer = None
            writer.close()

    def send(self, intent: Intent) -> bool:
        """Whether the intent went out; without a connection nothing is queued for later."""
        if self._writer is None or self._writer.is_closing():
            return False
        self._writer.write(encode(intent))
        return True
