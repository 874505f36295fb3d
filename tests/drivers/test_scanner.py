"""The scanner driver against the simulated sensor, and against sensors and servers that misbehave."""

import asyncio
import struct
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from drivers.errors import BadReply, DeviceFault, LinkDown, Refused, Timeout
from drivers.scanner import Scanner, _heeding
from drivers.wire.scanner import Stamp, encode_cloud, encode_stamp, quantise
from simulators.faults import Delivery, Faults
from simulators.scanner import ScannerDevice, ScannerPorts, serve_scanner

HOST = "127.0.0.1"
CLOUD = encode_cloud(*quantise(np.array([[[1.0, 2.0, 3.0], [np.nan] * 3]])))
GroupOf = Callable[[Stamp], bytes]


def right(stamp: Stamp) -> bytes:
    return encode_stamp(stamp) + CLOUD


@dataclass
class Sensor:
    """A served sensor whose groups are made by `group`."""

    device: ScannerDevice = field(default_factory=ScannerDevice)
    group: GroupOf = right
    exposures: int = 0
    ports: ScannerPorts = field(default_factory=lambda: ScannerPorts(modbus=0, control=0, data=0))

    async def expose(self) -> GroupOf:
        self.exposures += 1
        return self.group

    def scanner(self, timeout_s: float = 0.3, **ports: int) -> Scanner:
        return Scanner(
            host=HOST,
            modbus_port=ports.get("modbus", self.ports.modbus),
            control_port=ports.get("control", self.ports.control),
            data_port=ports.get("data", self.ports.data),
            serial=93111,
            capture_timeout_s=timeout_s,
        )


@asynccontextmanager
async def served(faults: Faults | None = None) -> AsyncIterator[Sensor]:
    sensor = Sensor()
    async with serve_scanner(
        sensor.device, sensor.expose, ports=sensor.ports, clock=time.monotonic, data_faults=faults
    ) as sensor.ports:
        yield sensor


async def test_it_prepares_and_captures_frame_after_frame() -> None:
    async with served() as sensor, sensor.scanner(5.0) as scanner:
        await scanner.prepare()
        await scanner.prepare()
        for number in (1, 2, 3):
            frame = await scanner.capture()
            assert (frame.frame_index, frame.scanner_serial) == (number, 93111)
            np.testing.assert_allclose(frame.points_mm, [(1.0, 2.0, 3.0)], atol=1e-3)
        status = await scanner.status()
        assert (status.running, status.frame_index) == (True, 3)
        assert sensor.exposures == 3


async def test_a_stopped_sensor_is_not_triggered() -> None:
    async with served() as sensor, sensor.scanner() as scanner:
        with pytest.raises(DeviceFault, match="is stopped"):
            await scanner.capture()
        assert sensor.exposures == 0


async def test_c2_a_lost_trigger_is_sent_once_more() -> None:
    async with served() as sensor, sensor.scanner() as scanner:
        await scanner.prepare()
        sensor.device.lose_triggers = 1
        assert (await scanner.capture()).frame_index == 1
        assert sensor.exposures == 1


async def test_c4_a_frame_of_an_earlier_trigger_is_told_by_its_time() -> None:
    """Somebody's trigger is still being served when ours comes: the next index is theirs, the time tells."""
    async with served() as sensor, sensor.scanner(5.0) as scanner:
        await scanner.prepare()
        early = iter([replace])

        def first_is_theirs(stamp: Stamp) -> bytes:
            if next(early, None) is None:
                return right(stamp)
            sensor.device.pending += 1
            return right(replace(stamp, timestamp_us=stamp.timestamp_us - 60_000_000))

        sensor.group = first_is_theirs
        assert (await scanner.capture()).frame_index == 2


async def test_c16_a_frame_before_its_trigger_is_none() -> None:
    async with served() as sensor, sensor.scanner(0.1) as scanner:
        await scanner.prepare()
        sensor.group = lambda stamp: right(replace(stamp, timestamp_us=0))
        with pytest.raises(Timeout):
            await scanner.capture()


async def test_c2_two_lost_triggers_are_a_timeout() -> None:
    async with served() as sensor, sensor.scanner(0.1) as scanner:
        await scanner.prepare()
        sensor.device.lose_triggers = 2
        with pytest.raises(Timeout, match=r"no frame within"):
            await scanner.capture()
        assert sensor.exposures == 0


async def test_a_frame_that_was_taken_but_never_came_is_not_taken_again() -> None:
    """The index moved: the trigger was not lost, so none is sent."""
    async with served(Faults(drop=1.0)) as sensor, sensor.scanner(0.1) as scanner:
        await scanner.prepare()
        with pytest.raises(Timeout):
            await scanner.capture()
        assert sensor.exposures == 1


async def test_c4_a_stale_frame_is_passed_over() -> None:
    async with served() as sensor, sensor.scanner() as scanner:
        await scanner.prepare()
        first = await scanner.capture()
        sensor.group = lambda stamp: first.raw + right(stamp)
        second = await scanner.capture()
        assert second.frame_index == 2
        assert second.timestamp_us > first.timestamp_us


async def test_frames_of_other_peoples_triggers_are_drained() -> None:
    async with served() as sensor, sensor.scanner() as mine, sensor.scanner() as theirs:
        await mine.prepare()
        for _ in range(6):
            await theirs.capture()
        assert (await mine.capture()).frame_index == 7


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"frame_index": 3}, "frame 3, want 1"),
        ({"scanner_serial": 4711}, "frame of scanner 4711, want 93111"),
    ],
)
async def test_c3_c19_a_frame_with_a_wrong_stamp_is_a_bad_reply(change: dict[str, int], what: str) -> None:
    async with served() as sensor, sensor.scanner() as scanner:
        await scanner.prepare()
        sensor.group = lambda stamp: right(replace(stamp, **change))
        with pytest.raises(BadReply, match=what):
            await scanner.capture()


class Cut(Faults):
    """Sends the first `length` bytes of each group and hangs up."""

    length = 0

    def deliver(self, data: bytes) -> Delivery:
        return Delivery(data=data[: self.length], hang_up=True)


@pytest.mark.parametrize("length", [0, 1, 6, 40, 69, 70, 71, 100, len(CLOUD) + 69])
async def test_c6_a_connection_lost_in_mid_frame_is_link_down(length: int) -> None:
    cut = Cut()
    cut.length = length
    async with served(cut) as sensor, sensor.scanner(5.0) as scanner:
        await scanner.prepare()
        with pytest.raises(LinkDown, match="connection was closed"):
            await scanner.capture()


async def test_c6_a_frame_that_never_ends_is_a_timeout() -> None:
    async with served() as sensor, sensor.scanner(0.1) as scanner:
        await scanner.prepare()
        sensor.group = lambda stamp: right(stamp)[:-1]
        with pytest.raises(Timeout, match="no frame"):
            await scanner.capture()


@pytest.mark.parametrize(
    "group",
    [
        lambda stamp: CLOUD,
        lambda stamp: encode_stamp(stamp, last=True),
        lambda stamp: encode_stamp(stamp) + CLOUD[:10] + b"\xff" * 20 + CLOUD[30:],
        lambda stamp: b"\xff\xff\xff\xff\x01\x00",
        lambda stamp: b"\x00" * 64,
    ],
)
async def test_c8_c24_a_corrupt_group_is_a_bad_reply(group: GroupOf) -> None:
    async with served() as sensor, sensor.scanner() as scanner:
        await scanner.prepare()
        sensor.group = group
        with pytest.raises(BadReply, match=f"scanner on {HOST}:"):
            await scanner.capture()


async def test_an_empty_picture_is_a_frame() -> None:
    blind = encode_cloud(*quantise(np.full((2, 2, 3), np.nan)))
    async with served() as sensor, sensor.scanner() as scanner:
        await scanner.prepare()
        sensor.group = lambda stamp: encode_stamp(stamp) + blind
        assert (await scanner.capture()).points_mm.shape == (0, 3)


async def test_a_frame_that_modbus_does_not_confirm_is_a_bad_reply(monkeypatch: pytest.MonkeyPatch) -> None:
    """A second frame, triggered by somebody else, moves the register past ours."""
    monkeypatch.setattr("drivers.scanner._AGREE_S", 0.05)
    async with served() as sensor, sensor.scanner() as scanner:
        await scanner.prepare()

        def doubled(stamp: Stamp) -> bytes:
            sensor.device.frame_index += 1
            return right(stamp)

        sensor.group = doubled
        with pytest.raises(BadReply, match="agreement by Modbus"):
            await scanner.capture()


async def test_captures_do_not_run_into_each_other() -> None:
    async with served() as sensor, sensor.scanner(5.0) as scanner:
        await scanner.prepare()
        frames = await asyncio.gather(*(scanner.capture() for _ in range(4)))
        assert [frame.frame_index for frame in frames] == [1, 2, 3, 4]


@pytest.mark.parametrize("channel", ["control", "data"])
async def test_a_channel_that_is_not_there_is_link_down(channel: str) -> None:
    async with served() as sensor:
        with pytest.raises(LinkDown, match=f"scanner on {HOST}:1: no connection"):
            async with sensor.scanner(**{channel: 1}):
                pass


async def test_a_modbus_that_is_not_there_is_link_down(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.scanner._CONNECT_S", 0.1)
    async with served() as sensor:
        with pytest.raises(LinkDown, match="no Modbus connection"):
            async with sensor.scanner(modbus=1):
                pass


Answer = Callable[[bytes], bytes]


@asynccontextmanager
async def answering(answer: Answer) -> AsyncIterator[int]:
    """A server that answers each chunk it gets with `answer(chunk)`."""
    writers: list[asyncio.StreamWriter] = []

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writers.append(writer)
        while chunk := await reader.read(4096):
            writer.write(answer(chunk))

    server = await asyncio.start_server(serve, HOST, 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
        for writer in writers:
            writer.close()
            with suppress(OSError):
                await writer.wait_closed()


@pytest.mark.parametrize(
    ("answer", "error"),
    [
        (lambda _: b"", Timeout),
        (lambda _: bytes.fromhex("0a000000 1145 18fcffff"), Refused),
        (lambda _: bytes.fromhex("0c000000 1145 01000000 6404"), BadReply),
        (lambda _: bytes.fromhex("0a000000 1045 01000000"), BadReply),
        (lambda _: bytes.fromhex("06000000 1145"), BadReply),
        (lambda _: bytes.fromhex("ffffffff 1145"), BadReply),
    ],
)
async def test_a_control_channel_that_misbehaves(
    answer: Answer, error: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.scanner._REPLY_S", 0.1)
    async with served() as sensor, answering(answer) as port, sensor.scanner(control=port) as scanner:
        with pytest.raises(error, match="scanner on"):
            await scanner.prepare()


async def test_after_silence_the_control_channel_is_not_used_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A late reply carries no id: it must never be taken for the next."""
    monkeypatch.setattr("drivers.scanner._REPLY_S", 0.05)
    async with served() as sensor, answering(lambda _: b"") as port, sensor.scanner(control=port) as scanner:
        with pytest.raises(Timeout):
            await scanner.prepare()
        with pytest.raises(LinkDown):
            await scanner.prepare()


def registers(request: bytes, *, count: int | None = None, function: int = 3, **head: int) -> bytes:
    """The answer to a request for holding registers, all of value 1; what is given goes wrong."""
    transaction, _, _, unit, _, _, asked = struct.unpack(">HHHBBHH", request[:12])
    count = asked if count is None else count
    body = struct.pack(">BBB", head.get("unit", unit), function, 2 * count) + b"\0\1" * count
    transaction = head.get("transaction", transaction)
    return struct.pack(">HHH", transaction, head.get("protocol", 0), len(body)) + body


LIES: dict[str, Answer] = {
    "transaction zero": lambda request: registers(request, transaction=0),
    "another transaction": lambda request: registers(request, transaction=999),
    "another unit": lambda request: registers(request, unit=9),
    "another protocol": lambda request: registers(request, protocol=1),
    "a register too few": lambda request: registers(request, count=request[11] - 1),
    "a register too many": lambda request: registers(request, count=request[11] + 1),
    "function 4": lambda request: registers(request, function=4),
    "half an answer": lambda request: registers(request)[:-1],
    "garbage before it": lambda request: b"\xff\xff" + registers(request),
    "silence": lambda _: b"",
    "an exception": lambda request: request[:4] + b"\0\3" + request[6:7] + b"\x83\x06",
}


@pytest.mark.parametrize("lie", LIES)
async def test_t6_t7_t8_a_modbus_server_that_lies_is_never_believed(
    lie: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """T6: what pymodbus accepts. T7: what it rejects, as silence. T8: silence ends within two short waits."""
    monkeypatch.setattr("drivers.scanner._MODBUS_S", 0.1)
    async with served() as sensor, answering(LIES[lie]) as port, sensor.scanner(modbus=port) as scanner:
        began_s = time.monotonic()
        with pytest.raises((BadReply, Timeout, Refused), match=f"scanner on {HOST}:{port}: registers 300"):
            await scanner.status()
        assert time.monotonic() - began_s < 1.0


@pytest.mark.parametrize("lie", [lie for lie in LIES if lie != "an exception"])
async def test_c21_one_lie_is_forgiven_on_a_new_connection(lie: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.scanner._MODBUS_S", 0.1)
    lies = iter([LIES[lie]])

    def one_lie(request: bytes) -> bytes:
        return next(lies, registers)(request)

    async with (
        served() as sensor,
        answering(one_lie) as port,
        sensor.scanner(modbus=port) as scanner,
    ):
        assert (await scanner.status()).running


async def test_t7_a_late_answer_is_not_taken_for_the_next() -> None:
    """The first answer comes with the second request: transaction ids tell them apart."""
    late: list[bytes] = []

    def one_behind(request: bytes) -> bytes:
        late.append(registers(request))
        return late[-2] + late[-1] if len(late) > 1 else b""

    async with served() as sensor, answering(one_behind) as port, sensor.scanner(modbus=port) as scanner:
        assert (await scanner.status()).running


async def test_t9_a_lost_answer_sends_nothing_twice_on_one_connection(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("drivers.scanner._MODBUS_S", 0.1)
    seen: list[bytes] = []

    def silent(request: bytes) -> bytes:
        seen.append(request)
        return b""

    async with served() as sensor, answering(silent) as port, sensor.scanner(modbus=port) as scanner:
        with pytest.raises(Timeout):
            await scanner.status()
        assert [len(chunk) for chunk in seen] == [12, 12]


@pytest.mark.parametrize("channel", ["modbus", "control", "data"])
async def test_t10_a_cancelled_wait_is_cancelled(channel: str) -> None:
    """T10: a client that turned cancellation into an error of its own would swallow an abort."""
    async with (
        served() as sensor,
        answering(lambda _: b"") as port,
        sensor.scanner(30.0, **{channel: port}) as scanner,
    ):
        sensor.device.running = channel != "control"
        waiting: Awaitable[object] = scanner.prepare() if channel == "control" else scanner.capture()
        task = asyncio.ensure_future(waiting)
        await asyncio.sleep(0.05)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task


async def test_t10_a_cancellation_that_meets_the_answer_is_not_lost() -> None:
    """`asyncio.wait_for` of Python 3.11 gives the answer and forgets the cancellation."""

    async def swallows() -> str:
        with suppress(asyncio.CancelledError):
            await asyncio.sleep(60.0)
        return "answer"

    task = asyncio.ensure_future(_heeding(swallows()))
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task


async def test_t10_calls_of_a_cleanup_after_a_cancellation_work() -> None:
    async def cleanup() -> bool:
        try:
            await asyncio.sleep(60.0)
        except asyncio.CancelledError:
            return await _heeding(asyncio.sleep(0, True))
        return False

    task = asyncio.ensure_future(cleanup())
    await asyncio.sleep(0)
    task.cancel()
    assert await task


async def test_c20_a_sensor_that_went_away_is_link_down() -> None:
    async with AsyncExitStack() as stack:
        sensor = await stack.enter_async_context(served())
        scanner = sensor.scanner()
        async with scanner:
            await scanner.prepare()
            await stack.aclose()
            with pytest.raises(LinkDown):
                await scanner.capture()
