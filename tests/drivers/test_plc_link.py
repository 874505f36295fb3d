"""The station's Modbus server, as two PLCs of other making see it."""

import asyncio
import logging
import socket
import struct
import subprocess
import sys
import textwrap
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import TypeVar

import pytest
from pymodbus.client import AsyncModbusTcpClient
from pyModbusTCP.client import ModbusClient

from drivers.errors import LinkDown
from drivers.plc import HeartbeatWatch, PlcLink
from drivers.wire.plc import (
    Ctrl,
    FaultCode,
    PlcRequest,
    ResultBlock,
    StatusBits,
    VerdictCode,
    decode_result,
    encode_request,
)

T = TypeVar("T")
HOST = "127.0.0.1"
REQUEST = PlcRequest(ctrl=Ctrl.ENABLE | Ctrl.START, sequence=42, recipe=1, serial="SN-0007")
RESULT = ResultBlock(
    sequence=42, verdict=VerdictCode.SCRAP, serial="SN-0007", record_id=17, time_ms=1_763_770_000_000
)
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS = 1, 2


@asynccontextmanager
async def opened() -> AsyncIterator[
    tuple[PlcLink, Callable[[Callable[[ModbusClient], T]], asyncio.Future[T]]]
]:
    """A link and a way to let an independent client work on it in a thread."""
    async with PlcLink.open(HOST, 0, epoch=5) as link:
        plc = ModbusClient(host=HOST, port=link.port, unit_id=1, timeout=2.0)
        try:
            yield link, lambda work: asyncio.ensure_future(asyncio.to_thread(work, plc))
        finally:
            plc.close()


@pytest.mark.parametrize("unit", [1, 0, 255])
async def test_a_plc_writes_its_request_and_reads_the_station(unit: int) -> None:
    def work(plc: ModbusClient) -> tuple[object, object, object]:
        plc.unit_id = unit
        return (
            plc.write_multiple_registers(0, encode_request(REQUEST)),
            plc.read_holding_registers(100, 40),
            plc.read_input_registers(190, 4),
        )

    async with opened() as (link, let):
        link.set_status(StatusBits.ONLINE | StatusBits.READY)
        link.set_state(4)
        written, station, pattern = await let(work)
        assert written
        assert link.request().sequence == 42
        assert link.request().serial == "SN-0007"
        assert station == [3, 0, 5, 4] + [0] * 36
        assert pattern == [0x1234, 0x1234, 0x5678, 0x4142]


async def test_parts_of_the_request_may_be_written_alone_and_read_back() -> None:
    def work(plc: ModbusClient) -> object:
        return (
            plc.write_single_register(5, 7),
            plc.write_multiple_registers(8, [0, 42, 1]),
            plc.read_holding_registers(0, 29),
        )

    async with opened() as (link, let):
        assert await let(work) == (True, True, [0, 0, 0, 0, 0, 7, 0, 0, 0, 42, 1] + [0] * 18)
        assert (link.request().recipe, link.request().ack_sequence, link.request().ack_code) == (7, 42, 1)


@pytest.mark.parametrize(
    ("address", "count"), [(28, 2), (29, 1), (100, 1), (106, 2), (139, 1), (190, 4), (199, 2)]
)
async def test_y1_writes_outside_the_plcs_registers_change_nothing(address: int, count: int) -> None:
    async with opened() as (link, let):
        link.publish(RESULT, StatusBits.RESULT_VALID)
        before = list(link._registers)
        assert not await let(lambda plc: plc.write_multiple_registers(address, [1] * count))
        assert await let(lambda plc: plc.last_except) == ILLEGAL_ADDRESS
        assert link._registers == before
        assert link.foreign_writes == (1 if address + count <= 200 else 0)


async def test_registers_that_do_not_exist_and_functions_that_do_not() -> None:
    async with opened() as (_, let):
        assert not await let(lambda plc: plc.read_holding_registers(190, 20))
        assert await let(lambda plc: plc.last_except) == ILLEGAL_ADDRESS
        for work in (
            lambda plc: plc.read_coils(0, 8),
            lambda plc: plc.read_discrete_inputs(0, 8),
            lambda plc: plc.write_single_coil(0, True),
            lambda plc: plc.write_read_multiple_registers(0, [1], 100, 1),
        ):
            assert not await let(work)
            assert await let(lambda plc: plc.last_except) == ILLEGAL_FUNCTION


async def test_a_published_result_is_whole_and_cleared_whole() -> None:
    async with opened() as (link, let):
        link.publish(RESULT, StatusBits.ONLINE | StatusBits.RESULT_VALID)
        image = await let(lambda plc: plc.read_holding_registers(100, 40))
        assert image[0] == StatusBits.ONLINE | StatusBits.RESULT_VALID
        assert decode_result(image[4:]) == RESULT
        link.clear_result()
        assert (await let(lambda plc: plc.read_holding_registers(104, 36))) == [0] * 36


async def test_a_refusal_shows_its_code_and_no_verdict() -> None:
    async with opened() as (link, let):
        link.publish(RESULT, StatusBits.RESULT_VALID)
        link.refuse(FaultCode.NEW_SEQUENCE_NEEDED, 306, StatusBits.ONLINE)
        image = await let(lambda plc: plc.read_holding_registers(100, 40))
        assert image[0] == StatusBits.ONLINE
        assert image[4:8] == [0, 0, 0, 0]
        assert image[8:10] == [306, 2]
        assert image[10:] == [0] * 30


async def test_p14_no_request_ever_sees_half_a_result() -> None:
    """A second stack reads 100-139 as fast as it can while results come and go."""
    other = ResultBlock(
        sequence=2**31, verdict=VerdictCode.PASS, serial="ZZ", record_id=2**32 - 1, time_ms=2**60
    )
    wholes = ([0] * 36, list(RESULT.encode()), list(other.encode()))
    async with opened() as (link, _):
        client = AsyncModbusTcpClient(HOST, port=link.port, retries=0, reconnect_delay=0)
        assert await client.connect()
        stop = asyncio.Event()

        async def publish() -> None:
            while not stop.is_set():
                link.publish(RESULT, StatusBits.RESULT_VALID)
                await asyncio.sleep(0)
                link.publish(other, StatusBits.RESULT_VALID)
                await asyncio.sleep(0)
                link.clear_result()
                link.set_status(StatusBits(0))
                await asyncio.sleep(0)

        publishing = asyncio.create_task(publish())
        for _ in range(300):
            image = (await client.read_holding_registers(100, count=40, device_id=1)).registers
            assert image[4:] in wholes
            assert bool(image[0]) == any(image[4:])
        stop.set()
        await publishing
        client.close()


async def test_a_change_wakes_the_station() -> None:
    async with opened() as (link, let):
        assert not await link.wait_change(0.01)
        await let(lambda plc: plc.write_single_register(0, 1))
        assert await link.wait_change(1.0)
        assert not await link.wait_change(0.01)
        await let(lambda plc: plc.write_single_register(0, 1))
        assert not await link.wait_change(0.01)


def test_p3_a_heartbeat_must_advance_three_times_and_lately() -> None:
    watch = HeartbeatWatch(2.0)
    for now_s in range(3):
        watch.see(now_s, float(now_s))
    assert not watch.alive(2.0)
    watch.see(3, 3.0)
    assert watch.alive(3.0)
    assert watch.alive(5.0)
    watch.see(3, 5.1)
    assert not watch.alive(5.1)
    watch.see(4, 6.0)
    watch.see(5, 6.5)
    assert not watch.alive(6.5)
    watch.see(6, 7.0)
    assert watch.alive(7.0)


def test_x28_a_heartbeat_that_wraps_is_alive() -> None:
    watch = HeartbeatWatch(2.0)
    for step in range(6):
        watch.see((65_533 + step) & 0xFFFF, 0.5 * step)
    assert watch.alive(2.5)


def test_the_stations_heartbeat_counts_every_half_second() -> None:
    link = PlcLink(host=HOST, port=0, epoch=70_000, watch=HeartbeatWatch(2.0))
    beats = []
    for tenth in range(21):
        link.beat(tenth / 10)
        beats.append(link.heartbeat)
    assert beats[-1] == 5
    assert set(beats) == {1, 2, 3, 4, 5}
    assert link._registers[102] == 70_000 & 0xFFFF


async def test_a_port_in_use_is_one_clear_error() -> None:
    with socket.socket() as taken:
        taken.bind((HOST, 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(LinkDown, match=rf"plc on {HOST}:{port}: cannot listen: Address already in use"):
            async with PlcLink.open(HOST, port):
                pass


async def test_the_port_is_free_again_at_once() -> None:
    """With a client still connected: its half-closed connection must not hold the port."""
    port = 0
    for _ in range(3):
        async with PlcLink.open(HOST, port) as link:
            port = link.port
            client = AsyncModbusTcpClient(HOST, port=port, retries=0, reconnect_delay=0)
            assert await client.connect()
            assert (await client.read_holding_registers(0, count=1, device_id=1)).registers == [0]
        client.close()


STATION = textwrap.dedent(
    """
    import asyncio, subprocess, sys
    from drivers.plc import PlcLink
    async def main():
        async with PlcLink.open("127.0.0.1", int(sys.argv[1])) as link:
            child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], close_fds=False)
            print(link.port, child.pid, flush=True)
            await asyncio.sleep(60)
    asyncio.run(main())
    """
)


def test_a_killed_stations_child_does_not_hold_the_port() -> None:
    children: list[int] = []
    port = "0"
    try:
        for _ in range(2):
            station = subprocess.Popen(
                [sys.executable, "-c", STATION, port], stdout=subprocess.PIPE, text=True
            )
            assert station.stdout is not None
            port, child = station.stdout.readline().split()
            children.append(int(child))
            with socket.create_connection((HOST, int(port))):
                station.kill()
                station.wait()
            station.stdout.close()
    finally:
        for child in children:
            subprocess.run(["kill", "-9", str(child)], check=True)


async def raw_exchange(port: int, frame: bytes) -> bytes:
    reader, writer = await asyncio.open_connection(HOST, port)
    writer.write(frame)
    try:
        return await asyncio.wait_for(reader.read(300), 0.2)
    except TimeoutError:
        return b""
    finally:
        writer.close()
        await writer.wait_closed()


@pytest.mark.parametrize(
    "frame",
    [
        b"",
        b"\x00",
        b"garbage that is no Modbus at all",
        struct.pack(">HHHBB", 1, 7, 6, 1, 3),
        struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 0, 0),
        struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 0, 126),
        struct.pack(">HHHBBHHB", 1, 0, 7, 1, 16, 0, 2, 4),
        struct.pack(">HHHBBHHBH", 1, 0, 9, 1, 16, 0, 2, 9, 1),
        struct.pack(">HHHBB", 1, 0, 2, 1, 99),
        b"\x00\x01\x00\x00\xff\xff\x01\x03",
    ],
)
async def test_y16_frames_that_are_none_leave_the_server_serving(frame: bytes) -> None:
    async with opened() as (link, let):
        await raw_exchange(link.port, frame)
        assert link.request() == PlcRequest(crc_expected=link.request().crc_expected)
        assert await let(lambda plc: plc.write_single_register(5, 1))


async def test_pymodbus_logs_go_nowhere(caplog: pytest.LogCaptureFixture) -> None:
    async with opened() as (_, let):
        await let(lambda plc: plc.read_coils(0, 8))
    assert not caplog.records
    assert not logging.getLogger("pymodbus.logging").propagate
