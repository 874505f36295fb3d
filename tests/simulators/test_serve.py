"""Byte servers: clients that come, go, die and do not read."""

import asyncio
import os
import socket
from contextlib import suppress

import pytest
import serial

from simulators.faults import Delivery, Faults
from simulators.serve import HangUp, serve_pty, serve_tcp

HOST = "127.0.0.1"


class Echo:
    def feed(self, data: bytes) -> list[bytes]:
        if b"!" in data:
            raise HangUp("enough")
        return [data]


class Late(Faults):
    def deliver(self, data: bytes) -> Delivery:
        return Delivery(data=data, delay_s=0.01)


async def exchange(port: int, data: bytes) -> bytes:
    reader, writer = await asyncio.open_connection(HOST, port)
    writer.write(data)
    answer = await asyncio.wait_for(reader.read(100), 5.0)
    writer.close()
    await writer.wait_closed()
    return answer


async def test_clients_are_answered_each_on_its_own() -> None:
    async with serve_tcp(HOST, 0, Echo) as server:
        assert await asyncio.gather(*(exchange(server.port, b"%d" % n) for n in range(20))) == [
            b"%d" % n for n in range(20)
        ]


async def test_a_session_may_hang_up_and_the_others_go_on() -> None:
    async with serve_tcp(HOST, 0, Echo) as server:
        reader, writer = await asyncio.open_connection(HOST, server.port)
        writer.write(b"!")
        with suppress(ConnectionResetError):
            assert await asyncio.wait_for(reader.read(), 5.0) == b""
        writer.close()
        assert await exchange(server.port, b"still here") == b"still here"


async def test_a_client_that_dies_hurts_nobody() -> None:
    async with serve_tcp(HOST, 0, Echo) as server:
        dead = socket.create_connection((HOST, server.port))
        dead.send(b"x" * 1000)
        dead.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
        dead.close()  # a reset, as from a killed process
        server.broadcast(b"hello")
        assert await exchange(server.port, b"still here") == b"still here"


async def test_a_client_that_does_not_read_is_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simulators.serve._MOST_UNREAD", 1_000_000)
    async with serve_tcp(HOST, 0, Echo) as server:
        with socket.create_connection((HOST, server.port)):
            while not server.clients:
                await asyncio.sleep(0)
            for _ in range(40):
                server.broadcast(bytes(1_000_000))
                await asyncio.sleep(0)
            assert not server.clients


async def test_a_late_message_still_arrives() -> None:
    async with serve_tcp(HOST, 0, Echo, Late()) as server:
        assert await exchange(server.port, b"late") == b"late"


async def test_a_pty_may_be_closed_and_opened_again() -> None:
    def talk(path: str) -> bytes:
        with serial.Serial(path, 115_200, timeout=5.0) as port:
            port.write(b"hello\r\n")
            return bytes(port.read(7))

    async with serve_pty(Echo()) as cable:
        for _ in range(3):
            assert await asyncio.to_thread(talk, cable.path) == b"hello\r\n"


async def test_what_nobody_reads_from_a_pty_is_lost() -> None:
    async with serve_pty(Echo()) as cable:
        for _ in range(100):
            cable.broadcast(bytes(1000))
        slave = os.open(cable.path, os.O_RDWR | os.O_NOCTTY)
        os.close(slave)
