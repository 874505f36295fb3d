"""The commands on a record: what they print, and with which status they end."""

import csv
import io
import json
import shutil
import sqlite3
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from station import commands_live as commands
from station.console import line_of
from station.demo import DemoFailed, Score, inspect_parts, read_truths, running_process, wait_for_addresses
from station.events import (
    AlarmCleared,
    AlarmRaised,
    DeviceStatus,
    Event,
    Handshake,
    LogLine,
    PartStarted,
    StationStatus,
    VerdictAcknowledged,
    VerdictReached,
    ViewCaptured,
)

AT = "2026-01-01T00:00:00.000+00:00"


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A configuration with a record of three requests beside it."""
    root = tmp_path_factory.mktemp("commands")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parent))
        import live_rig
        import record_workload

        ports = dict.fromkeys(("turntable", "modbus", "control", "data", "plc", "events"), 4711)
        live_rig.write_files(root, ports, mode="SIMULATION", scanner_serial=1)
        record_workload.work(root / "record")
    return root


@pytest.fixture
def config(template: Path, tmp_path: Path) -> Path:
    return shutil.copytree(template, tmp_path / "cell") / "station.toml"


def test_history_as_json(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert commands.history(config=config, as_json=True, last=20) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [(row["serial"], row["verdict"]) for row in rows] == [
        ("SN-1", "REPAIR"),
        ("SN-2", "HOLD"),
        ("SN-3", "PASS"),
    ]
    assert [row["released"] for row in rows] == [False, False, True]
    assert [row["interrupted"] for row in rows] == [False, True, False]


def test_history_as_lines(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert commands.history(config=config, as_json=False, last=2) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    assert "SN-3" in lines[1]
    assert "PASS" in lines[1]


def test_history_before_the_first_request(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.rmtree(config.parent / "record")
    assert commands.history(config=config, as_json=True, last=20) == 0
    assert json.loads(capsys.readouterr().out) == []


def test_verify_is_0_if_and_only_if_the_record_holds(
    config: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert commands.verify(config=config) == 0
    frame = config.parent / "record" / "jobs" / "000001" / "frames" / "000.gdp"
    frame.unlink()
    assert commands.verify(config=config) == 1
    assert "missing" in capsys.readouterr().out
    shutil.rmtree(config.parent / "record")
    assert commands.verify(config=config) == 1


def test_export_of_every_finding(config: Path, tmp_path: Path) -> None:
    assert commands.export(config=config, out=tmp_path / "out.csv") == 0
    rows = list(csv.DictReader(io.StringIO((tmp_path / "out.csv").read_text())))
    assert [(row["serial"], row["verdict"], row["characteristic"]) for row in rows] == [
        ("SN-1", "REPAIR", "sections[7.0].chord_mm"),
        ("SN-2", "HOLD", ""),
        ("SN-3", "PASS", "sections[7.0].chord_mm"),
    ]


def test_a_record_that_does_not_hold_is_not_exported(config: Path, tmp_path: Path) -> None:
    db = sqlite3.connect(config.parent / "record" / "record.sqlite")
    db.execute("DROP TRIGGER no_update")
    db.close()
    assert commands.export(config=config, out=tmp_path / "out.csv") == 1
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@x"])
def test_no_cell_is_a_formula(text: str) -> None:
    assert commands.inert(text) == f"'{text}"
    assert commands.inert(-1.0) == -1.0


def test_a_bad_configuration_is_one_line_and_status_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = tmp_path / "none.toml"
    statuses = (
        commands.run_station(config=missing, headless=True),
        commands.history(config=missing, as_json=False, last=1),
        commands.verify(config=missing),
        commands.export(config=missing, out=tmp_path / "x"),
        commands.tui(connect=None, config=missing),
        commands.tui(connect="nowhere:x", config=None),
    )
    assert set(statuses) == {2}
    assert len(capsys.readouterr().err.splitlines()) == len(statuses)


def test_addresses() -> None:
    assert commands.address("127.0.0.1:15600") == ("127.0.0.1", 15600)
    assert commands.address(":15600") == ("127.0.0.1", 15600)


def verdict(serial: str, word: str) -> VerdictReached:
    return VerdictReached(
        serial=serial,
        sequence=1,
        part_number="P",
        verdict=word,  # type: ignore[arg-type]
        route=None,
        reasons=("tip: depth 8.2 mm > serviceable 0.5 mm",),
        findings=(),
        record_no=1,
        durations_s={},
        simulated=True,
        at_utc=AT,
    )


EVENTS: list[tuple[Event, str | None]] = [
    (
        StationStatus(state="IDLE", mode="STUDY", packml=4, station_id="C", version="1"),
        "station   IDLE",
    ),
    (DeviceStatus(device="scanner", state="READY", detail="serial 1"), "scanner   READY  serial 1"),
    (
        PartStarted(serial="S", sequence=1, recipe=1, part_number="P", views=12, record_no=3, at_utc=AT),
        "part      S  record 3, 12 views",
    ),
    (
        ViewCaptured(index=0, total=12, angle_deg=0.0, points=7, sample_mm=""),
        "view      1/12 at 0.00 deg, 7 points",
    ),
    (verdict("S", "REPAIR"), "verdict   S  REPAIR  tip: depth 8.2 mm > serviceable 0.5 mm"),
    (
        VerdictAcknowledged(serial="S", sequence=1, record_no=1, code=1),
        "answer    S  the PLC took it, code 1",
    ),
    (
        AlarmRaised(number=2, priority=1, text="T", action="Do.", state="UNACK", first_out=True, at_utc=AT),
        "alarm     A002 T. Do.",
    ),
    (AlarmCleared(number=2), "alarm     A002 cleared"),
    (LogLine(level="debug", text="x", at_utc=AT), None),
    (LogLine(level="warning", text="x", at_utc=AT), "log       x"),
    (
        Handshake(plc_bits=(), station_bits=(), sequence=0, plc_heartbeat=0, station_heartbeat=0),
        None,
    ),
]


@pytest.mark.parametrize(("event", "line"), EVENTS)
def test_every_event_is_one_line_or_none(event: Event, line: str | None) -> None:
    assert line_of(event) == line


TRUTHS = '{"serial": "A", "verdict": "PASS"}\n{"serial": "B", "verdict": "SCRAP"}\n'


@pytest.mark.parametrize(
    ("verdicts", "status"),
    [
        ({"A": "PASS", "B": "SCRAP"}, 0),
        ({"A": "PASS", "B": "HOLD"}, 1),
        ({"A": "PASS"}, 1),
        ({"A": "PASS", "C": "PASS"}, 1),
    ],
)
def test_the_demo_ends_with_0_only_if_every_verdict_is_true(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    verdicts: dict[str, str],
    status: int,
) -> None:
    (tmp_path / "truth.log").write_text(TRUTHS)

    async def play(_: Path, score: Score) -> None:
        for serial, word in verdicts.items():
            score.hear(verdict(serial, word))
            score.hear(VerdictAcknowledged(serial=serial, sequence=1, record_no=1, code=1))

    monkeypatch.setattr("station.demo.run_until_done", play)
    assert inspect_parts(tmp_path, 2) == status
    lines = capsys.readouterr().out.splitlines()
    assert sum("agrees" in line or "DISAGREES" in line for line in lines) == len(verdicts)
    assert read_truths(tmp_path / "truth.log") == {"A": "PASS", "B": "SCRAP"}


def test_simulators_that_do_not_start_are_one_line(tmp_path: Path) -> None:
    log = tmp_path / "log"
    command = [sys.executable, "-c", "import sys; sys.exit('no such preset')"]
    with log.open("wb") as stream, running_process(command, out=-1, log=stream) as process:
        process.wait()
        with pytest.raises(DemoFailed, match="no such preset"):
            wait_for_addresses(process, log)


def test_a_process_that_does_not_listen_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("station.demo.END_S", 0.2)
    deaf = "import signal, time; signal.signal(15, signal.SIG_IGN); print(1, flush=True); time.sleep(99)"
    with (tmp_path / "log").open("wb") as log:
        with running_process([sys.executable, "-c", deaf], out=-1, log=log) as process:
            assert process.stdout is not None
            process.stdout.readline()
        assert process.returncode == -9


def test_the_screen_watches_a_station_of_its_own(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a terminal `run` starts the station as a process and opens the screen on its stream."""
    seen: dict[str, object] = {}

    def watch(command: list[str], path: Path, folder: Path) -> int:
        seen.update(command=command, path=path, folder=folder)
        return 0

    monkeypatch.setattr(commands, "on_terminal", lambda: True)
    monkeypatch.setattr("station.demo.watch_station", watch)
    assert commands.run_station(config=config, headless=False) == 0
    assert seen["folder"] == config.parent / "record"
    assert SimpleNamespace(**seen).command[-3:] == ["-m", "station.run", str(config)]
