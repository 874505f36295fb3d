"""The whole simulated cell as its users see it: a process that prints addresses and serves until SIGTERM."""

import asyncio
import hashlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyModbusTCP.client import ModbusClient
from pyModbusTCP.server import ModbusServer
from zaber_motion.ascii import Connection

from drivers.plc import PlcLink
from drivers.scanner import Scanner
from drivers.turntable import Turntable
from drivers.wire.plc import Ctrl, ResultBlock, StatusBits, VerdictCode
from drivers.wire.scanner import RangeFrame, Stamp, decode_group, encode_cloud, encode_stamp, quantise
from simulators.cell import BadJob, LoadedPart, Order, RecordedParts, Studio, StudioFailed, read_job
from simulators.station_files import free_port

START_S = 150.0
STAMP = Stamp(frame_index=1, timestamp_us=1, scanner_serial=93111)


@dataclass
class Running:
    """A cell in its own process."""

    process: "subprocess.Popen[str]"
    addresses: dict[str, Any]

    def port(self, *path: str) -> int:
        place: Any = self.addresses
        for name in path:
            place = place[name]
        return int(place.rpartition(":")[2])

    def table(self) -> Turntable:
        return Turntable(port=self.addresses["turntable"]["pty"], settle_s=0.0)

    def scanner(self) -> Scanner:
        return Scanner(
            host="127.0.0.1",
            modbus_port=self.port("scanner", "modbus"),
            control_port=self.port("scanner", "control"),
            data_port=self.port("scanner", "data"),
            serial=93111,
        )


def start(*options: str) -> Running:
    """A cell whose line of addresses has come, and nothing before it."""
    command = [sys.executable, "-m", "simulators", "serve", "--json", *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    watchdog = threading.Timer(START_S, process.kill)
    watchdog.start()
    line = process.stdout.readline()
    watchdog.cancel()
    if not line:
        _, err = process.communicate()
        raise AssertionError(err)
    return Running(process=process, addresses=json.loads(line))


def end(running: Running) -> int:
    """The exit status after SIGTERM."""
    running.process.send_signal(signal.SIGTERM)
    running.process.communicate(timeout=20.0)
    return running.process.returncode


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cell")


@pytest.fixture(scope="module")
def cell(folder: Path) -> Iterator[Running]:
    running = start(
        "--preset=PASS",
        "--seed=3",
        "--without=plc",
        f"--write-config={folder / 'station.toml'}",
        f"--truth-log={folder / 'truth.jsonl'}",
    )
    yield running
    assert end(running) == 0


async def views(running: Running, angles_deg: tuple[float, ...]) -> list[RangeFrame]:
    async with running.table() as table, running.scanner() as scanner:
        await table.home()
        await scanner.prepare()
        frames = []
        for angle_deg in angles_deg:
            await table.move_to(angle_deg)
            frames.append(await scanner.capture())
        return frames


def nearest_mm(points_mm: np.ndarray, others_mm: np.ndarray) -> np.ndarray:
    """Distance of each point to its nearest other, the slow way."""
    return np.array([np.sqrt(((others_mm - point) ** 2).sum(axis=1).min()) for point in points_mm])


async def test_the_part_turns_with_the_table(cell: Running, folder: Path) -> None:
    """Views 30 deg apart fall on one another once each is turned back about the calibrated axis."""
    calibration = tomllib.loads((folder / "calibration.toml").read_text())
    T = np.array(calibration["T_scanner_table0"])
    assert calibration["scanner_serial"] == 93111
    angles_deg = (0.0, 30.0)
    clouds = []
    for angle_deg, frame in zip(angles_deg, await views(cell, angles_deg), strict=True):
        table_mm = (frame.points_mm - T[:3, 3]) @ T[:3, :3]
        c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
        clouds.append(table_mm @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))
    assert all(len(cloud) > 20_000 for cloud in clouds)
    apart_mm = nearest_mm(clouds[0][::1000], clouds[1])
    assert np.percentile(apart_mm, 30) < 0.2


async def test_a_picture_is_quantised_below_the_noise(cell: Running) -> None:
    (frame,) = await views(cell, (0.0,))
    for axis in range(3):
        step_mm = np.diff(np.unique(frame.points_mm[:, axis])).min()
        assert step_mm <= 0.0025


def test_the_configuration_names_what_listens(cell: Running, folder: Path) -> None:
    config = tomllib.loads((folder / "station.toml").read_text())
    assert config["schema"] == "bladecell.station/1"
    assert config["mode"] == "SIMULATION"
    assert config["turntable"]["port"] == cell.addresses["turntable"]["pty"]
    assert config["scanner"]["data_port"] == cell.port("scanner", "data")
    assert config["plc"]["port"] == cell.port("station_modbus")
    plan = folder / config["recipes"]["1"]
    assert (plan.parent / tomllib.loads(plan.read_text())["nominal"]).stat().st_size > 1000
    assert (folder / config["calibration"]["file"]).exists()


def test_the_truth_of_the_loaded_part_is_logged(cell: Running, folder: Path) -> None:
    (line,) = (folder / "truth.jsonl").read_text().splitlines()
    truth = json.loads(line)
    assert (truth["index"], truth["verdict"]) == (0, "PASS")
    assert truth["serial"]


def test_the_makers_client_and_a_modbus_client_share_the_cell(cell: Running) -> None:
    with Connection.open_tcp("127.0.0.1", cell.port("turntable", "tcp")) as connection:
        connection.default_request_timeout = 2000
        axis = connection.detect_devices(identify_devices=False)[0].get_axis(1)
        axis.home()
        axis.move_absolute(128_000)
        plc = ModbusClient(host="127.0.0.1", port=cell.port("scanner", "modbus"), unit_id=1)
        assert plc.read_holding_registers(300, 1) is not None
        plc.close()
        assert axis.get_position() == 128_000


TRIGGER_AND_DIE = """
import os, socket, struct, sys
control, data = (socket.create_connection(("127.0.0.1", int(port))) for port in sys.argv[1:3])
for command in (0x100D, 0x4510):
    control.sendall(struct.pack("<IH", 6, command))
    control.recv(100)
os.kill(os.getpid(), 9)
"""


async def test_it_outlives_clients_that_die(cell: Running) -> None:
    ports = [str(cell.port("scanner", channel)) for channel in ("control", "data")]
    died = subprocess.run([sys.executable, "-c", TRIGGER_AND_DIE, *ports], check=False)
    assert died.returncode == -signal.SIGKILL
    async with cell.scanner() as scanner:
        await scanner.prepare()
        async with asyncio.timeout(20.0):
            index = (await scanner.status()).frame_index
        assert index >= 0
    assert len(await views(cell, (0.0,))) == 1
    assert cell.process.poll() is None


async def test_the_loop_answers_while_the_camera_computes(cell: Running) -> None:
    """A status poll of the table never waits for the picture."""
    worst_s = 0.0
    async with cell.table() as table, cell.scanner() as scanner:
        await scanner.prepare()
        capture = asyncio.ensure_future(scanner.capture())
        while not capture.done():
            began_s = time.monotonic()
            await table.status()
            worst_s = max(worst_s, time.monotonic() - began_s)
            await asyncio.sleep(0.005)
        await capture
    assert worst_s < 0.5


def children(process: "subprocess.Popen[str]") -> list[int]:
    listings = Path(f"/proc/{process.pid}/task").glob("*/children")
    return [int(child) for listing in listings for child in listing.read_text().split()]


@pytest.mark.skipif(sys.platform != "linux", reason="finds the process in /proc")
async def test_a_bench_that_dies_is_set_up_again_with_its_part(cell: Running) -> None:
    (before,) = await views(cell, (0.0,))
    benches = [
        pid for pid in children(cell.process) if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
    ]
    assert len(benches) == 1
    os.kill(benches[0], signal.SIGKILL)
    (after,) = await views(cell, (0.0,))
    assert abs(len(after.points_mm) - len(before.points_mm)) < 0.02 * len(before.points_mm)
    np.testing.assert_allclose(after.points_mm.mean(axis=0), before.points_mm.mean(axis=0), atol=0.1)


def recorded_job(folder: Path, serial: str, angles_deg: tuple[float, ...], seed: int) -> Path:
    """A job folder as a station leaves it."""
    rng = np.random.default_rng(seed)
    rows = []
    (folder / "frames").mkdir(parents=True)
    for number, angle_deg in enumerate(angles_deg):
        stamp = Stamp(frame_index=50 + number, timestamp_us=7, scanner_serial=777)
        raw = encode_stamp(stamp) + encode_cloud(*quantise(rng.normal(0.0, 10.0, (5, 6, 3))))
        name = f"frames/{number:03d}.gdp"
        (folder / name).write_bytes(raw)
        rows.append(
            {
                "file": name,
                "angle_deg": angle_deg,
                "frame_index": 50 + number,
                "sha256": hashlib.sha256(raw).hexdigest(),
                "bytes": len(raw),
            }
        )
    inputs = {}
    for role in ("plan", "nominal", "calibration", "configuration"):
        (folder / "inputs").mkdir(exist_ok=True)
        (folder / "inputs" / f"{role}.x").write_text(role)
        inputs[role] = {"sha256": hashlib.sha256(role.encode()).hexdigest(), "file": f"inputs/{role}.x"}
    (folder / "inputs.json").write_text(json.dumps(inputs))
    (folder / "frames.json").write_text(json.dumps(rows))
    ticket = {"serial": serial, "sequence": 1, "recipe": 1, "part_number": "P"}
    (folder / "ticket.json").write_text(json.dumps(ticket))
    return folder


async def test_a_replayed_job_comes_back_bit_by_bit_and_its_serials_in_order(tmp_path: Path) -> None:
    angles_deg = (0.0, 10.0, 19.9998)
    jobs = [recorded_job(tmp_path / name, name, angles_deg, seed) for seed, name in enumerate(("A-1", "B-2"))]
    config, log = tmp_path / "station.toml", tmp_path / "plc.jsonl"
    running = start(
        *(f"--replay={job}" for job in jobs), f"--write-config={config}", f"--plc-log={log}", "--parts=2"
    )
    try:
        serials = await serve_two_parts(running, jobs, angles_deg)
    finally:
        assert end(running) == 0
    assert serials == ["A-1", "B-2"]
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert [(line["event"], line["serial"], line["verdict"]) for line in lines] == [
        ("verdict", "A-1", "HOLD"),
        ("verdict", "B-2", "HOLD"),
    ]
    written = tomllib.loads(config.read_text())
    assert (tmp_path / written["recipes"]["1"]).read_text() == "plan"
    assert (tmp_path / written["calibration"]["file"]).read_text() == "calibration"
    assert written["scanner"]["serial"] == 777


async def serve_two_parts(running: Running, jobs: list[Path], angles_deg: tuple[float, ...]) -> list[str]:
    """Be the station: scan each part that the PLC asks about, and publish HOLD."""
    serials: list[str] = []
    index = 0
    async with (
        PlcLink.open("127.0.0.1", running.port("station_modbus")) as link,
        running.table() as table,
        Scanner(
            host="127.0.0.1",
            modbus_port=running.port("scanner", "modbus"),
            control_port=running.port("scanner", "control"),
            data_port=running.port("scanner", "data"),
            serial=777,
        ) as scanner,
    ):
        beating = asyncio.ensure_future(beat(link))
        await table.home()
        await scanner.prepare()
        for job in jobs:
            link.set_status(StatusBits.ONLINE | StatusBits.READY)
            await wait_for(link, Ctrl.START)
            request = link.request()
            assert request.serial is not None
            serials.append(request.serial)
            link.set_status(StatusBits.ONLINE | StatusBits.START_ACK | StatusBits.BUSY)
            for number, angle_deg in enumerate(angles_deg):
                await table.move_to(angle_deg)
                frame = await scanner.capture()
                index += 1
                assert frame.frame_index == index
                recorded = decode_group((job / f"frames/{number:03d}.gdp").read_bytes())
                assert frame.points_mm.tobytes() == recorded.points_mm.tobytes()
            await table.move_to(30.0)
            assert (await scanner.capture()).points_mm.shape == (0, 3)
            index += 1
            link.publish(
                ResultBlock(
                    sequence=request.sequence,
                    verdict=VerdictCode.HOLD,
                    serial=request.serial,
                    record_id=1,
                    time_ms=1,
                ),
                StatusBits.ONLINE | StatusBits.RESULT_VALID,
            )
            await wait_for(link, Ctrl.RESULT_ACK)
            link.clear_result()
            link.set_status(StatusBits.ONLINE)
        await asyncio.sleep(0.2)
        beating.cancel()
    return serials


async def beat(link: PlcLink) -> None:
    while True:
        link.beat(asyncio.get_running_loop().time())
        await asyncio.sleep(0.05)


async def wait_for(link: PlcLink, bit: Ctrl) -> None:
    async with asyncio.timeout(20.0):
        while not link.request().has(bit):
            await link.wait_change(0.1)


def test_it_ends_at_once_even_while_it_starts() -> None:
    command = [sys.executable, "-m", "simulators", "serve", "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    time.sleep(1.5)  # long enough for the handler, too short for the first part
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=20.0)
    assert (process.returncode in (0, -signal.SIGTERM), out, err) == (True, "", "")


async def test_a_preset_that_is_none_is_said_in_one_line() -> None:
    studio = Studio(Order(preset="NONE-SUCH", seed=0), ahead=False)
    try:
        with pytest.raises(StudioFailed, match="NONE-SUCH"):
            await studio.load(0)
    finally:
        studio.close()


async def test_frames_are_found_by_angle_whatever_the_turn(tmp_path: Path) -> None:
    parts = RecordedParts((read_job(recorded_job(tmp_path / "j", "J", (0.0, 350.0), 0)),))
    assert await parts.load(5) == LoadedPart(index=5, serial="J", truth=None)
    stamp = Stamp(frame_index=1, timestamp_us=1, scanner_serial=777)
    seen = [len(decode_group((await parts.expose(a))(stamp)).points_mm) for a in (359.99, 360.01, -10.0, 5.0)]
    assert seen == [30, 30, 30, 0]


async def test_a_frame_changed_on_disk_is_not_served(tmp_path: Path) -> None:
    folder = recorded_job(tmp_path / "j", "J", (0.0, 10.0), 0)
    parts = RecordedParts((read_job(folder),))
    (folder / "frames/001.gdp").write_bytes(b"something else")
    with pytest.raises(BadJob, match=r"001\.gdp"):
        await parts.expose(10.0)


@pytest.mark.parametrize("missing", ["ticket.json", "frames.json", "frames/000.gdp"])
def test_a_folder_that_is_no_job_is_one_line_and_exit_2(tmp_path: Path, missing: str) -> None:
    folder = recorded_job(tmp_path / "j", "J", (0.0,), 0)
    (folder / missing).unlink()
    command = [sys.executable, "-m", "simulators", "serve", f"--replay={folder}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert len(done.stderr.splitlines()) == 1
    assert missing in done.stderr


def test_parts_left_out_leave_their_addresses_to_others(tmp_path: Path) -> None:
    job = recorded_job(tmp_path / "j", "J", (0.0,), 0)
    base = free_port("127.0.0.1")
    running = start(
        f"--replay={job}", "--without=turntable", "--without=scanner", "--without=plc", f"--ports={base}"
    )
    try:
        assert running.addresses == {
            "turntable": {"tcp": f"127.0.0.1:{base}", "pty": None},
            "scanner": {
                "modbus": f"127.0.0.1:{base + 1}",
                "control": f"127.0.0.1:{base + 2}",
                "data": f"127.0.0.1:{base + 3}",
            },
            "station_modbus": f"127.0.0.1:{base + 4}",
        }
        for offset in range(5):
            with socket.socket() as probe:
                probe.bind(("127.0.0.1", base + offset))
    finally:
        assert end(running) == 0


def test_the_plc_talks_to_a_station_of_other_making(tmp_path: Path) -> None:
    """A Modbus server that is none of ours stands in for the station; the request arrives in it."""
    job = recorded_job(tmp_path / "j", "OTHER-1", (0.0,), 0)
    running = start(f"--replay={job}")
    server = ModbusServer(host="127.0.0.1", port=running.port("station_modbus"), no_block=True)
    server.start()
    try:
        heartbeat = 0
        deadline_s = time.monotonic() + 20.0
        while not (ctrl := server.data_bank.get_holding_registers(0, 1)[0]) & Ctrl.START:
            heartbeat += 1
            server.data_bank.set_holding_registers(
                100, [int(StatusBits.ONLINE | StatusBits.READY), heartbeat]
            )
            assert time.monotonic() < deadline_s
            time.sleep(0.05)
        assert ctrl & (Ctrl.ENABLE | Ctrl.PART_PRESENT) == Ctrl.ENABLE | Ctrl.PART_PRESENT
        text = server.data_bank.get_holding_registers(12, 4)
        assert b"".join(value.to_bytes(2, "big") for value in text) == b"OTHER-1\0"
    finally:
        server.stop()
        assert end(running) == 0
