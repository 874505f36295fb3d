"""The simulated turntable: physics in virtual time, then the maker's own client on both wires."""

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from zaber_motion import (
    BadCommandException,
    BadDataException,
    MovementFailedException,
    RequestTimeoutException,
)
from zaber_motion.ascii import Axis, Connection

from drivers.wire.turntable import Reply, decode_answer
from simulators.motion import Motion, change_speed, move_to, rest
from simulators.serve import serve_pty, serve_tcp
from simulators.turntable import STEPS_PER_TURN, TurntableDevice, TurntableSession

TOP, RATE = 600_000.0, 5_000_000.0


def ask(device: TurntableDevice, words: str, now_s: float) -> Reply:
    line = device.answer(f"/1 1 07 {words}".encode(), now_s)
    assert line is not None
    reply = decode_answer(line)
    assert isinstance(reply, Reply)
    assert reply.id == 7
    return reply


def homed() -> TurntableDevice:
    device = TurntableDevice()
    ask(device, "home", 0.0)
    assert ask(device, "get pos", 10.0).data == "0"
    return device


def sampled_speeds(motion: Motion, until_s: float) -> list[float]:
    return [motion.at(motion.start_s + until_s * i / 1000)[1] for i in range(1001)]


@given(
    st.floats(-1e6, 1e6),
    st.floats(-TOP, TOP),
    st.floats(-1e6, 1e6),
)
def test_a_motion_ends_at_rest_on_its_target_within_its_limits(
    here: float, speed: float, target: float
) -> None:
    motion = move_to(1.0, here, speed, target, TOP, RATE)
    duration_s = motion.end_s - motion.start_s
    before, after = motion.at(motion.end_s - 1e-9), motion.at(motion.end_s)
    assert motion.at(1.0) == pytest.approx((here, speed), abs=1e-3)
    assert after == (target, 0.0)
    assert before == pytest.approx((target, 0.0), abs=0.1)
    speeds = sampled_speeds(motion, duration_s)
    assert max(map(abs, speeds)) <= max(TOP, abs(speed)) + 1e-3
    step_s = duration_s / 1000
    assert all(abs(b - a) <= RATE * step_s + 1e-3 for a, b in pairwise(speeds))


def test_thirty_degrees_take_the_time_of_a_trapezoid() -> None:
    """v/a + d/v = 0.12 + 0.21333 s for 128 000 microsteps at 600 000/s and 5 000 000/s2."""
    assert move_to(0.0, 0.0, 0.0, 128_000.0, TOP, RATE).end_s == pytest.approx(1 / 3, abs=1e-9)


def test_a_short_move_is_a_triangle() -> None:
    """2 sqrt(d/a) for a way too short to reach full speed."""
    assert move_to(0.0, 0.0, 0.0, 20_000.0, TOP, RATE).end_s == pytest.approx(2 * (20_000 / RATE) ** 0.5)


def test_a_changed_speed_lasts() -> None:
    motion = change_speed(0.0, 0.0, 0.0, 1000.0, 500.0)
    assert motion.at(2.0) == pytest.approx((1000.0, 1000.0))
    assert motion.at(12.0) == pytest.approx((11_000.0, 1000.0))
    assert rest(5.0, 3.0).at(99.0) == (3.0, 0.0)


def test_it_comes_up_unreferenced_and_homing_makes_zero() -> None:
    device = TurntableDevice()
    first = ask(device, "", 0.0)
    assert (first.flag, first.busy) == ("WR", False)
    assert ask(device, "warnings", 0.0).data == "01 WR"
    assert device.angle_deg(0.0) == pytest.approx(46.875)
    assert ask(device, "home", 0.0).busy
    assert ask(device, "", 10.0) == Reply(device=1, axis=1, id=7, ok=True, busy=False, flag="--", data="0")
    assert ask(device, "get pos", 10.0).data == "0"
    assert device.angle_deg(10.0) == 0.0


def test_positions_do_not_wrap_but_the_table_does() -> None:
    device = homed()
    assert ask(device, "get limit.cycle.dist", 10.0).data == "1536000"
    assert ask(device, "move abs 1536000", 10.0).ok
    assert ask(device, "get pos", 20.0).data == "1536000"
    assert device.angle_deg(20.0) == 0.0
    ask(device, "move rel -128000", 20.0)
    assert ask(device, "get pos", 30.0).data == "1408000"
    assert device.angle_deg(30.0) == pytest.approx(330.0)


def test_velocity_is_in_the_units_of_the_wire() -> None:
    """`move vel N` turns at N / 1.6384 microsteps a second."""
    device = homed()
    ask(device, "move vel 163840", 10.0)
    first, later = (int(ask(device, "get pos", now_s).data) for now_s in (20.0, 30.0))
    assert later - first == pytest.approx(1_000_000, abs=1)
    assert ask(device, "", 30.0).busy
    ask(device, "stop", 30.0)
    assert not ask(device, "", 31.0).busy


def test_a_stop_brakes_and_leaves_ni() -> None:
    device = homed()
    ask(device, "move abs 768000", 10.0)
    assert ask(device, "stop", 10.3).busy
    ended = ask(device, "", 11.0)
    assert (ended.busy, ended.flag) == (False, "NI")
    assert 0 < int(ask(device, "get pos", 11.0).data) < 768_000
    assert ask(device, "warnings clear", 11.0).data == "01 NI"
    assert ask(device, "", 11.0).flag == "--"


def test_an_order_cut_short_by_another_leaves_ni() -> None:
    device = homed()
    ask(device, "move abs 768000", 10.0)
    assert ask(device, "move abs 0", 10.3).flag == "NI"
    assert ask(device, "get pos", 20.0).data == "0"


def test_a_jam_stops_with_fs() -> None:
    device = homed()
    device.stall_after(50_000, 10.0)
    ask(device, "move abs 128000", 10.0)
    jammed = ask(device, "", 11.0)
    assert (jammed.busy, jammed.flag) == (False, "FS")
    assert ask(device, "get pos", 11.0).data == "50000"


def test_a_restart_forgets_the_reference() -> None:
    device = homed()
    ask(device, "move abs 128000", 10.0)
    ask(device, "system reset", 11.0)
    assert ask(device, "", 11.0).flag == "WR"
    assert ask(device, "get pos", 11.0).data == "0"
    assert device.angle_deg(11.0) == pytest.approx(30.0)


def test_a_position_set_by_hand_is_not_a_home() -> None:
    device = TurntableDevice()
    ask(device, "set pos 1000", 0.0)
    assert (ask(device, "", 0.0).flag, ask(device, "get pos", 0.0).data) == ("WH", "1000")


def test_checksums_and_alerts_come_when_asked_for() -> None:
    device = homed()
    ask(device, "set comm.checksum 1", 10.0)
    assert ask(device, "", 10.0).checked
    ask(device, "set comm.alert 1", 10.0)
    ask(device, "move abs 128000", 10.0)
    assert device.alert(10.1) is None
    alert = device.alert(11.0)
    assert alert is not None
    assert decode_answer(alert).__class__.__name__ == "Alert"
    assert device.alert(11.1) is None


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("dance", "BADCOMMAND"),
        ("get", "BADCOMMAND"),
        ("get nonsense", "BADCOMMAND"),
        ("get comm.packet.size.max", "BADCOMMAND"),
        ("get pos pos", "BADCOMMAND"),
        ("set nonsense 1", "BADCOMMAND"),
        ("set deviceid 1", "BADCOMMAND"),
        ("set maxspeed 0", "BADDATA"),
        ("set maxspeed fast", "BADDATA"),
        ("set comm.alert 2", "BADDATA"),
        ("move", "BADCOMMAND"),
        ("move sideways 1", "BADCOMMAND"),
        ("move abs", "BADCOMMAND"),
        ("move abs x", "BADDATA"),
        ("move abs 1.5", "BADDATA"),
        ("move abs 1e3", "BADDATA"),
        ("move abs 99999999999", "BADDATA"),
        ("move abs 1 0", "BADDATA"),
        ("move vel 99999999", "BADDATA"),
        ("home now", "BADCOMMAND"),
        ("warnings forget", "BADCOMMAND"),
        ("tools dance", "BADCOMMAND"),
    ],
)
def test_what_it_cannot_do_is_rejected_with_the_reason(words: str, reason: str) -> None:
    device = homed()
    reply = ask(device, words, 10.0)
    assert (reply.ok, reply.data) == (False, reason)
    assert ask(device, "get pos", 20.0).data == "0"


def test_addresses() -> None:
    device = TurntableDevice()
    assert device.answer(b"/2 1 07 home", 0.0) is None
    assert device.answer(b"/1 1 -- stop", 0.0) is None
    assert device.answer(b"/1 1 07 home:00", 0.0) is None
    assert device.answer(b"/", 0.0) == b"@01 0 OK IDLE WR 0"
    assert device.answer(b"/1 2 07 home", 0.0) == b"@01 2 07 RJ IDLE WR BADAXIS"


@given(st.lists(st.binary(max_size=40), max_size=5))
def test_any_lines_leave_the_device_answering(lines: list[bytes]) -> None:
    session = TurntableSession(TurntableDevice(), lambda: 0.0)
    session.feed(b"\n".join(lines))
    replies = b"".join(session.feed(b"\r\n/1 1 09 get limit.cycle.dist\r\n"))
    assert replies.endswith(b"1536000\r\n")


def test_a_line_of_3000_bytes_is_skipped() -> None:
    session = TurntableSession(TurntableDevice(), lambda: 0.0)
    assert session.feed(b"/1 1 08 " + b"x" * 3000 + b"\r\n") == []
    assert session.feed(b"/1 1 09\r\n") == [b"@01 1 09 OK IDLE WR 0\r\n"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Served:
    device: TurntableDevice
    port: int
    path: str

    def open(self, wire: str) -> Connection:
        if wire == "tcp":
            return Connection.open_tcp("127.0.0.1", self.port)
        return Connection.open_serial_port(self.path)


@asynccontextmanager
async def served() -> AsyncIterator[Served]:
    device = TurntableDevice()

    def session() -> TurntableSession:
        return TurntableSession(device, time.monotonic)

    async with serve_tcp("127.0.0.1", 0, session) as tcp, serve_pty(session()) as cable:
        yield Served(device=device, port=tcp.port, path=cable.path)


def axis_of(connection: Connection) -> Axis:
    connection.default_request_timeout = 500
    (device,) = connection.detect_devices(identify_devices=False)
    return device.get_axis(1)


@pytest.mark.parametrize("wire", ["tcp", "pty"])
async def test_the_makers_client_homes_and_moves(wire: str) -> None:
    def drive(table: Served) -> None:
        for _ in range(2):  # the wire may be closed and opened again
            with table.open(wire) as connection:
                axis = axis_of(connection)
                axis.home()
                assert axis.is_homed()
                assert axis.get_position() == 0
                axis.move_absolute(128_000)
                assert axis.get_position() == 128_000
                axis.move_relative(-64_000)
                assert axis.get_position() == 64_000
                assert axis.settings.get("limit.cycle.dist") == STEPS_PER_TURN

    async with served() as table:
        await asyncio.to_thread(drive, table)


@pytest.mark.parametrize("wire", ["tcp", "pty"])
async def test_the_makers_client_sees_a_stall(wire: str) -> None:
    def drive(table: Served) -> None:
        with table.open(wire) as connection:
            axis = axis_of(connection)
            axis.home()
            table.device.stall_after(30_000, time.monotonic())
            with pytest.raises(MovementFailedException) as caught:
                axis.move_absolute(128_000)
            assert caught.value.details.warnings == ["FS"]

    async with served() as table:
        await asyncio.to_thread(drive, table)


async def test_the_makers_client_turns_stops_and_is_refused() -> None:
    def drive(table: Served) -> None:
        with table.open("tcp") as connection:
            axis = axis_of(connection)
            axis.home()
            axis.move_velocity(163_840)
            assert axis.is_busy()
            axis.stop()
            assert not axis.is_busy()
            with pytest.raises(BadDataException):
                axis.generic_command("move abs nowhere")
            with pytest.raises(BadCommandException):
                axis.generic_command("dance")
            axis.device.generic_command("system reset")
            assert axis.warnings.get_flags() == {"WR"}

    async with served() as table:
        await asyncio.to_thread(drive, table)


async def test_two_wires_show_one_table() -> None:
    def drive(table: Served) -> None:
        with table.open("tcp") as tcp, table.open("pty") as cable:
            by_tcp, by_cable = axis_of(tcp), axis_of(cable)
            by_tcp.home()
            by_tcp.move_absolute(128_000)
            assert by_cable.get_position() == 128_000

    async with served() as table:
        await asyncio.to_thread(drive, table)


async def test_the_makers_client_times_out_on_a_silent_address() -> None:
    def drive(table: Served) -> None:
        with table.open("tcp") as connection:
            connection.default_request_timeout = 100
            with pytest.raises(RequestTimeoutException):
                connection.get_device(2).get_axis(1).get_position()

    async with served() as table:
        await asyncio.to_thread(drive, table)
