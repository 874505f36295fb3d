"""The simulated scanner: its state in virtual time, and its three channels as strangers use them."""

import asyncio
import struct
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyModbusTCP.client import ModbusClient

from drivers.wire.scanner import (
    GroupSplitter,
    RangeFrame,
    Stamp,
    Status,
    decode_group,
    encode_cloud,
    encode_control,
    encode_stamp,
    quantise,
)
from simulators.scanner import ScannerDevice, ScannerPorts, serve_scanner

HOST = "127.0.0.1"
VERSION, STATES, START, STOP, TRIGGER = 0x4511, 0x4525, 0x100D, 0x1001, 0x4510
CLOUD = encode_cloud(*quantise(np.array([[[1.0, 2.0, 3.0], [np.nan] * 3]])))


def picture(stamp: Stamp) -> bytes:
    return encode_stamp(stamp) + CLOUD


@dataclass
class Stranger:
    """A client that knows the layouts and nothing of the product's driver."""

    ports: ScannerPorts
    device: ScannerDevice
    groups: list[bytes] = field(default_factory=list)

    async def control(self, command: int, payload: bytes = b"") -> tuple[int, int, bytes]:
        """Command, status and payload of the reply."""
        (answer,) = await self.control_frames([encode_control(command, payload)])
        return answer

    async def control_frames(self, frames: list[bytes]) -> list[tuple[int, int, bytes]]:
        reader, writer = await asyncio.open_connection(HOST, self.ports.control)
        answers = []
        for frame in frames:
            writer.write(frame)
            size, command, status = struct.unpack("<IHi", await asyncio.wait_for(reader.readexactly(10), 5.0))
            answers.append((command, status, await asyncio.wait_for(reader.readexactly(size - 10), 5.0)))
        writer.close()
        await writer.wait_closed()
        return answers

    async def modbus(self, work: Callable[[ModbusClient], object]) -> object:
        plc = ModbusClient(host=HOST, port=self.ports.modbus, unit_id=1, timeout=5.0)
        try:
            return await asyncio.to_thread(work, plc)
        finally:
            plc.close()

    async def index(self) -> int:
        registers = await self.modbus(lambda plc: plc.read_holding_registers(996, 4))
        assert isinstance(registers, list)
        return int.from_bytes(struct.pack(">4H", *registers), "big")


@asynccontextmanager
async def served(
    expose: Callable[[], object] | None = None, device: ScannerDevice | None = None
) -> AsyncIterator[Stranger]:
    device = device or ScannerDevice()

    async def now() -> Callable[[Stamp], bytes]:
        if expose is not None:
            expose()
        return picture

    ports = ScannerPorts(modbus=0, control=0, data=0)
    async with serve_scanner(device, now, ports=ports, clock=time.monotonic) as opened:
        yield Stranger(ports=opened, device=device)


@asynccontextmanager
async def listening(stranger: Stranger) -> AsyncIterator[Callable[[], asyncio.Future[RangeFrame]]]:
    """The next frame of the data channel, when called."""
    reader, writer = await asyncio.open_connection(HOST, stranger.ports.data)
    splitter = GroupSplitter()
    waiting: list[bytes] = []

    async def next_frame() -> RangeFrame:
        async with asyncio.timeout(5.0):
            while not waiting:
                waiting.extend(splitter.feed(await reader.read(65536)))
        return decode_group(waiting.pop(0))

    yield lambda: asyncio.ensure_future(next_frame())
    writer.close()
    await writer.wait_closed()


async def test_it_comes_up_stopped_and_takes_no_trigger() -> None:
    async with served() as stranger:
        assert await stranger.control(TRIGGER) == (TRIGGER, -1000, b"")
        assert await stranger.index() == 0


async def test_the_protocol_version_and_the_old_probe(manual_probe: bytes) -> None:
    async with served() as stranger:
        assert await stranger.control(VERSION) == (VERSION, 1, bytes([101, 4]))
        probed, version = await stranger.control_frames([manual_probe, encode_control(VERSION)])
        assert probed == (0, Status.INVALID_COMMAND, b"")
        assert version[1] == 1


@pytest.fixture
def manual_probe() -> bytes:
    return bytes.fromhex("10000000 00000000 00110000 00000000")


async def test_start_and_stop_act_on_one_state_whichever_way() -> None:
    async with served() as stranger:

        async def state() -> tuple[int, object]:
            _, _, payload = await stranger.control(STATES)
            count, first = struct.unpack_from("<Ii", payload)
            assert (count, len(payload)) == (11, 48)
            return first, await stranger.modbus(lambda plc: plc.read_holding_registers(300, 1))

        assert await state() == (0, [0])
        assert await stranger.control(START) == (START, 1, b"")
        assert await state() == (1, [1])
        assert await stranger.modbus(lambda plc: plc.write_multiple_registers(0, [0, 0]))
        assert await state() == (0, [0])
        assert await stranger.modbus(lambda plc: plc.write_single_register(0, 1))
        assert await state() == (1, [1])
        assert await stranger.control(STOP) == (STOP, 1, b"")
        assert await state() == (0, [0])


async def test_one_trigger_gives_one_group_to_every_client_and_moves_the_index_by_one() -> None:
    async with served() as stranger, listening(stranger) as one, listening(stranger) as two:
        await stranger.control(START)
        for number in (1, 2, 3):
            assert await stranger.control(TRIGGER) == (TRIGGER, 1, b"")
            first, second = await one(), await two()
            assert first.raw == second.raw
            assert (first.frame_index, first.scanner_serial) == (number, 93111)
            np.testing.assert_allclose(first.points_mm, [(1.0, 2.0, 3.0)], atol=1e-3)
            assert await stranger.index() == number
        stamp = await stranger.modbus(lambda plc: plc.read_holding_registers(992, 4))
        assert int.from_bytes(struct.pack(">4H", *stamp), "big") == first.timestamp_us  # type: ignore[misc]


async def test_every_accepted_trigger_gives_its_group_even_in_a_burst() -> None:
    async with served() as stranger, listening(stranger) as frame:
        await stranger.control(START)
        answers = await stranger.control_frames([encode_control(TRIGGER)] * 5)
        assert [status for _, status, _ in answers] == [1] * 5
        frames = [await frame() for _ in range(5)]
        assert [f.frame_index for f in frames] == [1, 2, 3, 4, 5]
        assert sorted({f.timestamp_us for f in frames}) == [f.timestamp_us for f in frames]
        assert await stranger.index() == 5


async def test_an_exposure_that_fails_sends_nothing_and_the_next_works(
    capsys: pytest.CaptureFixture[str],
) -> None:
    broken = iter([True])

    def expose() -> None:
        if next(broken, False):
            raise RuntimeError("no light")

    async with served(expose) as stranger, listening(stranger) as frame:
        await stranger.control(START)
        await stranger.control(TRIGGER)
        while stranger.device.pending:
            await asyncio.sleep(0)
        assert await stranger.index() == 0
        await stranger.control(TRIGGER)
        assert (await frame()).frame_index == 1
    assert "no light" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("address", "count"),
    [(0, 1), (64, 1), (65, 1), (299, 1), (300, 80), (372, 1), (383, 1), (959, 2), (1059, 2), (5000, 1)],
)
async def test_reading_outside_the_map_is_an_exception(address: int, count: int) -> None:
    def work(plc: ModbusClient) -> tuple[object, int]:
        return plc.read_holding_registers(address, count), plc.last_except

    async with served() as stranger:
        assert await stranger.modbus(work) == (None, 2)


@pytest.mark.parametrize(("address", "values"), [(300, [1]), (64, [0, 0]), (996, [1]), (0, [7]), (1060, [0])])
async def test_writing_outside_the_commands_is_an_exception(address: int, values: list[int]) -> None:
    def work(plc: ModbusClient) -> tuple[object, bool]:
        return plc.write_multiple_registers(address, values), plc.last_except > 0

    async with served() as stranger:
        assert await stranger.modbus(work) in ((None, True), (False, True))
        assert not stranger.device.running


async def test_the_whole_output_map_is_readable_by_both_functions() -> None:
    def work(plc: ModbusClient) -> list[object]:
        return [
            plc.read_holding_registers(300, 72),
            plc.read_holding_registers(375, 8),
            plc.read_holding_registers(960, 100),
            plc.read_input_registers(976, 24),
            plc.read_holding_registers(1000, 3),
        ]

    async with served() as stranger:
        blocks = await stranger.modbus(work)
        assert isinstance(blocks, list)
        assert all(blocks)
        assert blocks[-1] == [0x8000, 0, 2]


async def test_unknown_commands_and_noise_leave_the_sensor_serving() -> None:
    async with served() as stranger:
        assert (await stranger.control(0x7777, b"what"))[1] == Status.INVALID_COMMAND
        for noise in (b"\x00\x00\x00\x00\x00\x00", b"\xff" * 40, b"GET / HTTP/1.1\r\n\r\n", b"\x10"):
            reader, writer = await asyncio.open_connection(HOST, stranger.ports.control)
            writer.write(noise)
            writer.write_eof()
            assert await asyncio.wait_for(reader.read(), 5.0) == b""
            writer.close()
        assert (await stranger.control(VERSION))[1] == 1


@given(st.lists(st.tuples(st.booleans(), st.floats(0, 10)), max_size=20))
def test_index_and_time_only_ever_go_up(frames: list[tuple[bool, float]]) -> None:
    device = ScannerDevice()
    last = (0, 0)
    for running, now_s in frames:
        device.running = running
        if device.trigger() is Status.OK:
            stamp = device.next_stamp(now_s)
            assert stamp.frame_index == last[0] + 1
            assert stamp.timestamp_us > last[1]
            last = (stamp.frame_index, stamp.timestamp_us)
        assert device.read(996, 4, now_s) == [0, 0, 0, last[0]]


def test_a_lost_trigger_is_accepted_and_forgotten() -> None:
    device = ScannerDevice(running=True, lose_triggers=1)
    assert device.trigger() is Status.OK
    assert device.pending == 0
    assert device.trigger() is Status.OK
    assert device.pending == 1
