"""Servers of bytes over TCP and on a pty. A session turns what came into what is sent; servers carry it."""

import asyncio
import os
import pty
import tty
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from typing import Protocol

from simulators.faults import Faults

_MOST_UNREAD = 1 << 30  # a client that lets this much pile up is taken for dead


class Session(Protocol):
    """One client's side of a protocol."""

    def feed(self, data: bytes) -> list[bytes]:
        """The messages to send for what came; raises `HangUp` to drop the client."""


class HangUp(Exception):
    """The client sent what nothing can be made of."""


class Silent:
    """The session of a channel that only sends."""

    def feed(self, _data: bytes) -> list[bytes]:
        """Nothing, whatever came."""
        return []


class ByteServer(Protocol):
    """Where a device's messages to everybody go."""

    def broadcast(self, data: bytes) -> None:
        """Send to every client."""


class _TcpClient(asyncio.Protocol):
    def __init__(self, server: "TcpServer") -> None:
        self._server = server
        self._session = server.open_session()
        self._transport: asyncio.Transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._server.clients.add(self)

    def connection_lost(self, _exc: Exception | None) -> None:
        self._server.clients.discard(self)

    def data_received(self, data: bytes) -> None:
        try:
            replies = self._session.feed(data)
        except HangUp:
            self.close()
            return
        for reply in replies:
            self.send(reply)

    def send(self, data: bytes) -> None:
        """Send through the server's faults; a client that does not read is dropped."""
        delivery = self._server.faults.deliver(data)
        if self._transport.get_write_buffer_size() > _MOST_UNREAD:
            self.close()
        elif delivery.delay_s > 0.0:
            asyncio.get_running_loop().call_later(delivery.delay_s, self._transport.write, delivery.data)
        else:
            self._transport.write(delivery.data)
        if delivery.hang_up:
            self._transport.close()

    def close(self) -> None:
        """Drop the client."""
        self._transport.abort()


class TcpServer:
    """The clients of one TCP port."""

    def __init__(self, open_session: Callable[[], Session], faults: Faults) -> None:
        self.open_session = open_session
        self.faults = faults
        self.clients: set[_TcpClient] = set()
        self.port = 0

    def broadcast(self, data: bytes) -> None:
        """Send to every client."""
        for client in list(self.clients):
            client.send(data)


@asynccontextmanager
async def serve_tcp(
    host: str, port: int, open_session: Callable[[], Session], faults: Faults | None = None
) -> AsyncIterator[TcpServer]:
    """A server at `host`, on a free port if `port` is 0, until the block ends."""
    server = TcpServer(open_session, faults or Faults())
    listener = await asyncio.get_running_loop().create_server(lambda: _TcpClient(server), host, port)
    server.port = listener.sockets[0].getsockname()[1]
    try:
        yield server
    finally:
        listener.close()
        for client in list(server.clients):
            client.close()


class PtyServer:
    """The far end of a serial cable. Who opens `path` is the one client; it may come and go."""

    def __init__(self, session: Session, faults: Faults) -> None:
        self._session = session
        self._faults = faults
        # The slave stays open here too: else reading the master fails whenever the client closes.
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(self._slave)
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._master, self._read)

    def _read(self) -> None:
        with suppress(BlockingIOError, HangUp):
            for reply in self._session.feed(os.read(self._master, 4096)):
                self.broadcast(reply)

    def broadcast(self, data: bytes) -> None:
        """Send to whoever has the port open; what nobody reads is lost, as on a wire."""
        delivery = self._faults.deliver(data)
        if delivery.delay_s > 0.0:
            self._loop.call_later(delivery.delay_s, self._write, delivery.data)
        else:
            self._write(delivery.data)

    def _write(self, data: bytes) -> None:
        with suppress(OSError):
            os.write(self._master, data)

    def close(self) -> None:
        """Unplug the cable."""
        self._loop.remove_reader(self._master)
        os.close(self._master)
        os.close(self._slave)


@asynccontextmanager
async def serve_pty(session: Session, faults: Faults | None = None) -> AsyncIterator[PtyServer]:
    """A pty until the block ends."""
    server = PtyServer(session, faults or Faults())
    try:
        yield server
    finally:
        server.close()
