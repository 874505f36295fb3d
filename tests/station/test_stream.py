"""The event stream over loopback: a snapshot, then what happens; nobody can hold the cell up."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import numpy as np
import pytest

from station.events import (
    Acknowledge,
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
    SnapshotEnd,
    Start,
    StationStatus,
    StepStarted,
    ViewCaptured,
    decode,
    encode,
    pack,
)
from station.stream import KEPT_PARTS, MAX_CLIENTS, EventStream, Memory

AT = "2026-01-01T00:00:00.000+00:00"
HOST = "127.0.0.1"


def status(state: str) -> StationStatus:
    return StationStatus(state=state, mode="SIMULATION", packml=4, station_id="C", version="1")


def part(number: int) -> PartStarted:
    return PartStarted(
        serial=f"SN-{number}",
        sequence=number,
        recipe=1,
        part_number="P",
        views=2,
        record_no=number,
        at_utc=AT,
    )


def view(index: int) -> ViewCaptured:
    return ViewCaptured(index=index, total=2, angle_deg=0.0, points=1, sample_mm="")


def recorded(number: int) -> PartRecorded:
    return PartRecorded(
        record_no=number,
        serial="S",
        sequence=number,
        verdict="PASS",
        reason="",
        acknowledged=True,
        at_utc=AT,
    )


def alarm(number: int) -> AlarmRaised:
    return AlarmRaised(
        number=number, priority=2, text="T", action="A", state="UNACK", first_out=True, at_utc=AT
    )


def remembered(*events: Event) -> list[Event | BadEvent]:
    memory = Memory()
    for event in events:
        memory.keep(event, encode(event))
    return [decode(line) for line in memory.snapshot()]


def test_the_snapshot_is_the_present_state_and_nothing_else() -> None:
    device = DeviceStatus(device="scanner", state="READY")
    shown = remembered(
        status("BOOT"),
        alarm(101),
        alarm(111),
        device,
        part(1),
        view(0),
        view(1),
        AlarmCleared(number=101),
        status("IDLE"),
        part(2),
        StepStarted(step="scan"),
        view(0),
        view(0),
    )
    assert shown == [
        alarm(111),
        device,
        status("IDLE"),
        part(2),
        StepStarted(step="scan"),
        view(0),
        SnapshotEnd(),
    ]


def test_the_snapshot_stays_small_however_long_the_station_runs() -> None:
    shown = remembered(
        *(recorded(number) for number in range(100)),
        *(LogLine(level="info", text=str(number), at_utc=AT) for number in range(500)),
    )
    parts = [event.record_no for event in shown if isinstance(event, PartRecorded)]
    assert parts == list(range(100 - KEPT_PARTS, 100))
    assert len(shown) < 100


@asynccontextmanager
async def client(stream: EventStream) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    reader, writer = await asyncio.open_connection(HOST, stream.port, limit=1 << 22)
    try:
        yield reader, writer
    finally:
        writer.transport.abort()


async def next_event(reader: asyncio.StreamReader) -> Event | BadEvent:
    return decode(await asyncio.wait_for(reader.readline(), 5.0))


async def until_snapshot_end(reader: asyncio.StreamReader) -> list[Event | BadEvent]:
    seen = [await next_event(reader)]
    while seen[-1] != SnapshotEnd():
        seen.append(await next_event(reader))
    return seen


async def test_several_clients_get_the_snapshot_and_then_what_happens() -> None:
    heard: list[Intent] = []
    async with EventStream(HOST, 0, heard.append) as stream:
        stream.emit(status("IDLE"))
        async with client(stream) as (first, _), client(stream) as (second, _):
            for reader in (first, second):
                assert await until_snapshot_end(reader) == [status("IDLE"), SnapshotEnd()]
            stream.emit(part(1))
            assert await next_event(first) == part(1)
            assert await next_event(second) == part(1)


async def test_intents_are_heard_and_nonsense_is_not() -> None:
    heard: list[Intent] = []
    arrived = asyncio.Event()

    def hear(intent: Intent) -> None:
        heard.append(intent)
        arrived.set()

    async with EventStream(HOST, 0, hear) as stream, client(stream) as (reader, writer):
        await until_snapshot_end(reader)
        writer.write(b"\xff\xfe\n{}\n" + encode(Start()))
        await asyncio.wait_for(arrived.wait(), 5.0)
        arrived.clear()
        writer.write(encode(Acknowledge()))
        await asyncio.wait_for(arrived.wait(), 5.0)
        assert heard == [Start(), Acknowledge()]
        assert stream.bad_lines == 2


async def test_an_endless_line_drops_the_client() -> None:
    async with EventStream(HOST, 0, lambda intent: None) as stream, client(stream) as (reader, writer):
        await until_snapshot_end(reader)
        writer.write(b"x" * 100_000)
        with pytest.raises((ConnectionError, asyncio.IncompleteReadError)):
            await asyncio.wait_for(reader.readexactly(1), 5.0)


async def test_a_client_that_does_not_read_is_dropped_and_the_others_are_served() -> None:
    cloud = CloudMeasured(
        points_mm=pack(np.zeros((30_000, 3))),
        deviation_mm=pack(np.zeros(30_000)),
        serviceable_mm=None,
        repairable_mm=None,
    )
    async with (
        EventStream(HOST, 0, lambda intent: None) as stream,
        client(stream) as (reader, _),
        client(stream) as (deaf, deaf_writer),
    ):
        deaf_writer.transport.pause_reading()  # type: ignore[attr-defined]
        await until_snapshot_end(reader)
        loop = asyncio.get_running_loop()
        slowest_s = 0.0
        for _ in range(80):
            before_s = loop.time()
            stream.emit(cloud)
            slowest_s = max(slowest_s, loop.time() - before_s)
            assert await next_event(reader) == cloud
        assert slowest_s < 0.5
        assert len(stream._clients) == 1
        assert deaf is not None


async def test_clients_over_the_limit_are_turned_away() -> None:
    async with EventStream(HOST, 0, lambda intent: None) as stream:
        opened = [await asyncio.open_connection(HOST, stream.port) for _ in range(MAX_CLIENTS)]
        for reader, _ in opened:
            await until_snapshot_end(reader)
        extra, writer = await asyncio.open_connection(HOST, stream.port)
        with pytest.raises((ConnectionError, asyncio.IncompleteReadError)):
            await asyncio.wait_for(extra.readexactly(1), 5.0)
        for _, each in [*opened, (extra, writer)]:
            each.transport.abort()
        await asyncio.sleep(0)


async def test_a_client_that_dies_is_forgotten() -> None:
    async with EventStream(HOST, 0, lambda intent: None) as stream:
        async with client(stream) as (reader, _):
            await until_snapshot_end(reader)
        for _ in range(100):
            stream.emit(status("IDLE"))
            await asyncio.sleep(0.01)
            if not stream._clients:
                break
        assert not stream._clients
