"""The turntable driver against the simulated device on real wires, and against far ends that misbehave."""

import asyncio
import os
import pty
import time
import tty
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field

import numpy as np
import pytest

from drivers.errors import BadReply, DeviceFault, DriverError, LinkDown, Refused, Timeout
from drivers.line import open_line
from drivers.turntable import Turntable
from drivers.wire.turntable import with_lrc
from simulators.faults import Faults
from simulators.serve import PtyServer, TcpServer, serve_pty, serve_tcp
from simulators.turntable import Setting, TurntableDevice

QUICK_S = 0.2  # for a reply that never comes; those that do come may be late on a busy machine
Twist = Callable[[bytes, bytes | None], list[bytes]]


def as_is(_line: bytes, reply: bytes | None) -> list[bytes]:
    return [] if reply is None else [reply]


def quick(device: TurntableDevice) -> TurntableDevice:
    """Ten times the speed and a hundred times the acceleration that it is shipped with."""
    for words in (b"/1 1 set maxspeed 9830400", b"/1 1 set accel 81900"):
        device.answer(words, 0.0)
    return device


@dataclass
class Bench:
    """A served device whose replies pass through `twist(command line, reply line)`."""

    device: TurntableDevice = field(default_factory=lambda: quick(TurntableDevice()))
    twist: Twist = as_is
    deaf: Callable[[bytes], bool] = lambda _line: False
    seen: list[bytes] = field(default_factory=list)
    tcp: TcpServer | None = None
    cable: PtyServer | None = None

    def feed(self, data: bytes) -> list[bytes]:
        out: list[bytes] = []
        for line in data.split(b"\r\n"):
            if line:
                self.seen.append(line)
                heard = not self.deaf(line)
                out += self.twist(line, self.device.answer(line, time.monotonic()) if heard else None)
        return [reply + b"\r\n" for reply in out]

    def words(self) -> list[str]:
        """The commands seen, without address, id and LRC; polls left out."""
        texts = [line.decode().rpartition(":")[0].split(maxsplit=3)[3:] for line in self.seen]
        return [text[0] for text in texts if text]


@asynccontextmanager
async def bench(faults: Faults | None = None) -> AsyncIterator[Bench]:
    it = Bench()
    async with serve_tcp("127.0.0.1", 0, lambda: it, faults) as it.tcp, serve_pty(it, faults) as it.cable:
        yield it


def table(it: Bench, wire: str = "tcp", **options: float) -> Turntable:
    assert it.tcp is not None
    assert it.cable is not None
    port = f"socket://127.0.0.1:{it.tcp.port}" if wire == "tcp" else it.cable.path
    return Turntable(port=port, reply_timeout_s=options.get("reply_timeout_s", QUICK_S), settle_s=0.0)


@pytest.mark.parametrize("wire", ["tcp", "pty"])
async def test_it_homes_and_moves(wire: str) -> None:
    async with bench() as it, table(it, wire) as turntable:
        assert turntable.identity.microsteps_per_turn == 1_536_000
        assert not (await turntable.status()).homed
        await turntable.home()
        for angle_deg in (30.0, 330.0, 360.0, -15.0):
            assert await turntable.move_to(angle_deg) == pytest.approx(angle_deg, abs=0.0003)
            assert it.device.angle_deg(time.monotonic()) == pytest.approx(angle_deg % 360.0, abs=0.0003)
        status = await turntable.status()
        assert (status.busy, status.homed, status.flags) == (False, True, ())


async def test_every_command_carries_id_and_checksum_and_every_move_ends_upwards() -> None:
    async with bench() as it, table(it) as turntable:
        await turntable.home()
        await turntable.move_to(30.0)
        await turntable.move_to(10.0)
        moves = [int(words.split()[2]) for words in it.words() if words.startswith("move")]
    assert moves == [128_000, 38_400, 42_667]
    assert all(line[-3:-2] == b":" and line.split()[2].partition(b":")[0].isdigit() for line in it.seen)
    ids = [int(line.split()[2].partition(b":")[0]) for line in it.seen]
    assert ids == [(ids[0] + k) % 100 for k in range(len(ids))]


async def test_no_move_before_homing() -> None:
    async with bench() as it, table(it) as turntable:
        with pytest.raises(DeviceFault, match="not homed"):
            await turntable.move_to(30.0)
        assert not any(words.startswith("move") for words in it.words())


async def test_s10_a_stall_is_a_device_fault_until_homed_again() -> None:
    async with bench() as it, table(it) as turntable:
        await turntable.home()
        it.device.stall_after(30_000, time.monotonic())
        with pytest.raises(DeviceFault, match=r"stalled and stopped \(FS\)"):
            await turntable.move_to(30.0)
        assert "FS" in (await turntable.status()).flags
        await turntable.home()
        assert await turntable.move_to(30.0) == pytest.approx(30.0)


async def test_s13_a_restart_is_noticed_and_wants_homing() -> None:
    async with bench() as it, table(it) as turntable:
        await turntable.home()
        it.device.restart(time.monotonic())
        with pytest.raises(DeviceFault, match="lost its reference"):
            await turntable.move_to(30.0)
        with pytest.raises(DeviceFault, match="not homed"):
            await turntable.move_to(30.0)


async def test_a_restart_under_way_is_noticed() -> None:
    async with bench() as it, table(it) as turntable:
        await turntable.home()
        moving = asyncio.create_task(turntable.move_to(1800.0))
        while not any(words.startswith("move") for words in it.words()):
            await asyncio.sleep(0)
        it.device.restart(time.monotonic())
        with pytest.raises(DeviceFault, match="lost its reference"):
            await moving


async def test_a_stop_ends_a_move_and_the_move_is_not_repeated() -> None:
    async with bench() as it, table(it) as turntable:
        await turntable.home()
        moving = asyncio.create_task(turntable.move_to(1800.0))
        while not any(words.startswith("move") for words in it.words()):
            await asyncio.sleep(0)
        await turntable.stop()
        with pytest.raises(DeviceFault, match=r"stopped"):
            await moving
        assert sum(words.startswith("move") for words in it.words()) == 1
        assert not (await turntable.status()).busy


async def test_s24_a_driver_switched_off_is_a_device_fault() -> None:
    async with bench() as it, table(it) as turntable:
        await turntable.home()
        it.device.answer(b"/1 1 driver disable", time.monotonic())
        with pytest.raises(DeviceFault, match=r"driver disabled \(FO\)"):
            await turntable.move_to(30.0)


async def test_s19_a_device_that_is_busy_for_ever_is_a_device_fault() -> None:
    def busy(line: bytes, reply: bytes | None) -> list[bytes]:
        text = (reply or b"").rpartition(b":")[0].decode()
        return [with_lrc(text.replace("IDLE", "BUSY"))]

    async with bench() as it, table(it) as turntable:
        await turntable.home()
        it.twist = busy
        with pytest.raises(DeviceFault, match="still moving after"):
            await turntable.move_to(3.0)


async def test_s11_a_limit_is_a_refusal() -> None:
    async with bench() as it, table(it) as turntable:
        await turntable.home()
        with pytest.raises(Refused, match="BADDATA"):
            await turntable.move_to(1e6)


async def test_s12_stopping_short_is_a_fault() -> None:
    """The device says IDLE three degrees off."""

    def lie(line: bytes, reply: bytes | None) -> list[bytes]:
        if b"get pos" in line and reply is not None:
            head, _, data = reply.rpartition(b":")[0].rpartition(b" ")
            reply = with_lrc((head + b" %d" % (int(data) - 12_800)).decode())
        return as_is(line, reply)

    async with bench() as it, table(it) as turntable:
        await turntable.home()
        it.twist = lie
        with pytest.raises(DeviceFault, match=r"wanted 30\.0000"):
            await turntable.move_to(30.0)


async def test_s21_a_lost_command_is_sent_once_more() -> None:
    async with bench() as it, table(it) as turntable:
        await turntable.home()
        lost = iter([True])
        it.deaf = lambda line: b"move abs" in line and next(lost, False)
        assert await turntable.move_to(30.0) == pytest.approx(30.0)
        assert sum(words.startswith("move") for words in it.words()) == 2


async def test_s21_a_device_that_never_moves_is_told_twice_and_no_more() -> None:
    async with bench() as it, table(it) as turntable:
        await turntable.home()
        it.deaf = lambda line: b"move abs" in line
        with pytest.raises(DeviceFault, match="stopped at 0"):
            await turntable.move_to(30.0)
        assert sum(words.startswith("move") for words in it.words()) == 2


async def test_a_lost_reply_to_a_move_does_not_repeat_it() -> None:
    async with bench() as it, table(it) as turntable:
        await turntable.home()
        it.twist = lambda line, reply: [] if b"move abs" in line else as_is(line, reply)
        assert await turntable.move_to(30.0) == pytest.approx(30.0)
        assert sum(words.startswith("move") for words in it.words()) == 1


@pytest.mark.parametrize(
    "noise",
    [
        b"\xff\xfe\x00",
        b"@01 1 99 OK IDLE -- 777777",
        b"@02 1 05 OK IDLE -- 777777",
        b"@01 1 OK IDLE -- 777777",
        b"#01 1 hello",
        b"!01 1 IDLE --",
        b"POS 12",
    ],
)
async def test_s18_what_is_not_the_reply_changes_nothing(noise: bytes) -> None:
    async with bench() as it, table(it) as turntable:
        await turntable.home()
        it.twist = lambda line, reply: [noise, *as_is(line, reply), noise]
        assert await turntable.move_to(30.0) == pytest.approx(30.0)


async def test_s16_a_late_reply_is_never_taken_for_the_next() -> None:
    """Every reply comes with the next command, one too late: nothing is believed."""
    late: list[bytes] = []

    def one_behind(_line: bytes, reply: bytes | None) -> list[bytes]:
        out = late.copy()
        late[:] = [] if reply is None else [reply]
        return out

    async with bench() as it, table(it) as turntable:
        it.twist = one_behind
        with pytest.raises(Timeout, match="no reply within"):
            await turntable.status()


async def test_s4_queries_are_repeated_three_times() -> None:
    async with bench() as it, table(it) as turntable:
        it.seen.clear()
        it.twist = lambda _line, _reply: []
        with pytest.raises(Timeout, match="'warnings'"):
            await turntable.status()
        assert it.words() == ["warnings"] * 3


async def test_a_reply_without_its_checksum_is_noise_once_the_device_sends_them() -> None:
    async with bench() as it, table(it) as turntable:
        it.twist = lambda line, reply: [(reply or b"").rpartition(b":")[0]]
        with pytest.raises(Timeout):
            await turntable.status()


async def test_a_device_that_knows_no_checksums_is_believed_without() -> None:
    async with bench() as it:
        it.device._settings["comm.checksum"] = Setting("0")  # no bounds: `set` is rejected
        async with table(it) as turntable:
            await turntable.home()
            assert await turntable.move_to(30.0) == pytest.approx(30.0)


async def test_s8_local_echo_is_no_answer() -> None:
    async with bench() as it:
        it.twist = lambda line, _reply: [line]
        with pytest.raises(BadReply, match="not a reply"):
            async with table(it):
                pass


async def test_s7_a_device_that_is_no_turntable_is_refused() -> None:
    async with bench() as it:
        it.device._settings.pop("limit.cycle.dist")
        with pytest.raises(Refused, match=r"limit\.cycle\.dist.*BADCOMMAND"):
            async with table(it):
                pass


async def test_s6_an_endless_line_is_a_bad_reply() -> None:
    async with bench() as it, table(it) as turntable:
        it.twist = lambda _line, _reply: [b"x" * 5000]
        with pytest.raises(BadReply, match="more than 256 bytes"):
            await turntable.status()


async def test_t11_a_reply_in_two_halves_is_one_reply() -> None:
    """T11: half a line at the deadline is not a short number, and its rest is not the next reply."""
    async with bench() as it, table(it) as turntable:
        await turntable.home()
        await turntable.move_to(30.0)

        class Halves:
            def deliver(self, data: bytes) -> object:
                return self._normal.deliver(data[: len(data) // 2])

            _normal = Faults()

        assert it.tcp is not None
        it.tcp.faults = Halves()  # type: ignore[assignment]
        with pytest.raises((Timeout, BadReply)):
            await turntable.status()
        it.tcp.faults = Faults()
        assert (await turntable.status()).angle_deg == pytest.approx(30.0)


async def test_t13_s1_an_unplugged_cable_is_link_down_at_once() -> None:
    """T13: the master end of a pty closes, as when the plug is pulled."""
    async with bench() as it, table(it, "pty", reply_timeout_s=5.0) as turntable:
        await turntable.home()
        moving = asyncio.create_task(turntable.move_to(3500.0))
        while not any(words.startswith("move") for words in it.words()):
            await asyncio.sleep(0)
        assert it.cable is not None
        asyncio.get_running_loop().remove_reader(it.cable._master)
        os.close(it.cable._master)
        began_s = time.monotonic()
        with pytest.raises(LinkDown, match=r"turntable on /dev/pts"):
            await moving
        assert time.monotonic() - began_s < 1.0
        with pytest.raises(LinkDown):
            await turntable.stop()
        it.cable._master = os.open(os.devnull, os.O_RDWR)  # for the server's own close


async def test_s1_a_closed_connection_is_link_down() -> None:
    async with bench() as it, table(it) as turntable:
        assert it.tcp is not None
        for client in list(it.tcp.clients):
            client.close()
        with pytest.raises(LinkDown, match="socket://"):
            await turntable.status()


async def test_t12_a_second_station_does_not_get_the_port() -> None:
    """T12: the lock is flock, which another program of ours asks for and cannot have."""
    async with bench() as it, table(it, "pty"):
        with pytest.raises(LinkDown, match="does not open"):
            async with table(it, "pty"):
                pass


async def test_the_port_can_be_opened_again() -> None:
    async with bench() as it:
        for _ in range(2):
            async with table(it, "pty") as turntable:
                await turntable.home()


@pytest.mark.parametrize("port", ["/dev/nowhere", "socket://127.0.0.1:1", "socket://nonsense"])
async def test_a_port_that_is_not_there_is_link_down(port: str) -> None:
    with pytest.raises(LinkDown, match=port):
        async with Turntable(port=port, reply_timeout_s=QUICK_S):
            pass


async def test_s22_a_far_end_that_takes_nothing_is_a_timeout() -> None:
    master, slave = pty.openpty()
    tty.setraw(slave)
    try:
        line = await open_line("turntable", os.ttyname(slave), baud=115_200, timeout_s=1.0)
        with pytest.raises(Timeout, match="not taken"):
            await line.send(b"x" * 1_000_000, QUICK_S)
        line.close()
    finally:
        os.close(master)
        os.close(slave)


async def test_the_trace_sees_every_byte() -> None:
    traced: list[tuple[bool, bytes]] = []
    async with bench() as it:
        assert it.tcp is not None
        port = f"socket://127.0.0.1:{it.tcp.port}"
        async with Turntable(port=port, trace=lambda sent, data: traced.append((sent, data))):
            pass
        assert b"".join(data for sent, data in traced if sent).split(b"\r\n")[:-1] == it.seen
        assert b"".join(data for sent, data in traced if not sent).count(b"\r\n") == len(it.seen)


@pytest.mark.parametrize("seed", range(6))
async def test_noise_never_makes_a_wrong_angle(seed: int) -> None:
    """S4, S5: under flipped, cut and lost replies a move ends where it should or in an error."""
    rng = np.random.default_rng(seed)
    faults = Faults(rng=rng, drop=0.03, corrupt=0.1, truncate=0.03)
    async with bench() as it:
        assert it.tcp is not None
        with suppress(DriverError):
            async with table(it, reply_timeout_s=0.03) as turntable:
                await turntable.home()
                it.tcp.faults = faults
                for angle_deg in (20.0, 40.0, 10.0):
                    assert await turntable.move_to(angle_deg) == pytest.approx(angle_deg, abs=0.01)
                    true_deg = it.device.angle_deg(time.monotonic())
                    assert true_deg == pytest.approx(angle_deg, abs=0.01)


async def test_every_wait_ends_when_cancelled() -> None:
    async with bench() as it, table(it, reply_timeout_s=60.0) as turntable:
        it.twist = lambda _line, _reply: []
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(QUICK_S):
                await turntable.status()
        it.twist = as_is
        assert not (await turntable.status()).busy
