"""The command as a shell sees it: exit status, one line for bad input, nothing but the document on stdout."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from station import __main__ as command
from station.__main__ import app
from station.calibration import calibrate_from
from station.clouds import BadScan
from station.config import read_calibration
from tests.station.test_plans import PLAN

COMMANDS = {
    "demo",
    "run",
    "tui",
    "simulate",
    "inspect",
    "replay",
    "synth",
    "calibrate",
    "history",
    "export",
    "verify",
    "doctor",
}


def bladecell(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "station", *arguments],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=cwd,
        check=False,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])},
    )


def test_help_is_quick_and_names_every_command() -> None:
    bladecell("--help")  # the bytecode is there from now on
    begun_s = time.process_time_ns(), os.times().children_user
    done = bladecell("--help")
    spent_s = os.times().children_user - begun_s[1]
    assert done.returncode == 0
    assert all(name in done.stdout for name in COMMANDS)
    assert spent_s < 1.0
    assert {entry.name or entry.callback.__name__ for entry in app.registered_commands if entry.callback} == (
        COMMANDS
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "plan.toml").write_text(PLAN)
    (tmp_path / "nominal.stl").write_bytes(b"solid nothing\nendsolid\n")
    (tmp_path / "scan.xyz").write_text("1 2 3\n")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "result.json").write_text("earlier")
    return tmp_path


def refused(folder: Path, *arguments: str) -> str:
    """The one line of a refusal, once it is sure that nothing else happened."""
    own = dict(zip(arguments[::2], arguments[1::2], strict=True))
    given = {"--plan": "plan.toml", "--scan": "scan.xyz", "--out": "out", **own}
    flat = [word for pair in given.items() for word in pair]
    previous = Path.cwd()
    os.chdir(folder)
    try:
        done = CliRunner().invoke(app, ["inspect", *flat])
    finally:
        os.chdir(previous)
    assert done.exit_code == 2, done.output
    assert done.stdout == ""
    assert (folder / "out" / "result.json").read_text() == "earlier"
    assert done.stderr.startswith("bladecell: ")
    assert done.stderr.count("\n") == 1
    return done.stderr.rstrip("\n")


def test_bad_input_is_one_line_that_names_the_file(folder: Path) -> None:
    assert refused(folder, "--plan", "none.toml") == "bladecell: none.toml: No such file or directory"
    assert "plan.toml: nominal: " in refused(folder)  # the nominal is no mesh
    (folder / "plan.toml").write_text(PLAN.replace("0.20", "nan"))
    assert "plan.toml: limits.section.position_mm.repairable" in refused(folder)


def test_an_out_that_cannot_be_a_folder_is_refused_before_the_work(folder: Path) -> None:
    assert "is not a directory" in refused(folder, "--out", "scan.xyz")
    assert "is not a directory" in refused(folder, "--out", "scan.xyz/deeper")
    if os.geteuid() != 0:
        (folder / "locked").mkdir(mode=0o500)
        assert "cannot be written to" in refused(folder, "--out", "locked/new")


@pytest.mark.parametrize("serial", ["", "x" * 65, "SN\x1b[2J", "SN\u202e1", "a\nb"])
def test_a_serial_that_cannot_be_shown_is_refused(folder: Path, serial: str) -> None:
    line = refused(folder, "--serial", serial)
    assert line.isprintable()


def test_usage_errors_are_2() -> None:
    runner = CliRunner()
    assert runner.invoke(app, ["inspect"]).exit_code == 2
    assert runner.invoke(app, ["nonsense"]).exit_code == 2
    assert runner.invoke(app, ["inspect", "--plan"]).exit_code == 2


def test_synth_and_simulate_become_the_simulators(monkeypatch: pytest.MonkeyPatch) -> None:
    became: list[list[str]] = []
    monkeypatch.setattr(os, "execv", lambda _, words: became.append(words))
    runner = CliRunner()
    runner.invoke(app, ["synth", "--out", "x", "--preset", "PASS"])
    runner.invoke(app, ["simulate", "--json", "--without", "plc", "--help"])
    assert became[0][1:] == ["-P", "-m", "simulators.synth", "--out", "x", "--preset", "PASS"]
    assert became[1][1:] == ["-P", "-m", "simulators", "serve", "--json", "--without", "plc", "--help"]


def test_synth_passes_its_exit_status_through(tmp_path: Path) -> None:
    done = bladecell("synth", "--preset", "nonsense", "--out", str(tmp_path / "x"))
    assert done.returncode == 2
    assert "nonsense" in done.stderr


def test_doctor_names_what_is_wrong(folder: Path) -> None:
    done = bladecell("doctor", "--plan", "plan.toml", cwd=folder)
    assert done.returncode == 1
    assert "ok   package numpy" in done.stdout
    assert "BAD  plan plan.toml: plan.toml: nominal: " in done.stdout
    done = bladecell("doctor", "--config", "none.toml", cwd=folder)
    assert "BAD  configuration: none.toml: No such file" in done.stdout


SPHERES = "# sphere on the table\n" + "".join(
    f"{angle}, {x}, {y}, 40.0\n"
    for angle, x, y in [(0, 30, 0), (60, 15, 25.98), (120, -15, 25.98), (180, -30, 0), (240, -15, -25.98)]
)


def test_calibrate_writes_what_the_station_reads(tmp_path: Path) -> None:
    (tmp_path / "spheres.csv").write_text(SPHERES)
    out = tmp_path / "calibration.toml"
    done = bladecell(
        "calibrate", "--spheres", str(tmp_path / "spheres.csv"), "--out", str(out), "--scanner-serial", "7"
    )
    assert done.returncode == 0, done.stderr
    calibration = read_calibration(out)
    assert calibration.scanner_serial == 7
    assert calibration.T_scanner_table0[2][3] == pytest.approx(40.0, abs=0.01)


@pytest.mark.parametrize("text", ["", "0, 1, 2\n", "0, 1, 2, x\n", "0, 1, 2, nan\n", "0, 1, 2, 3\n"])
def test_spheres_that_show_no_axis_are_refused(tmp_path: Path, text: str) -> None:
    from datetime import UTC, datetime

    (tmp_path / "spheres.csv").write_text(text)
    with pytest.raises(BadScan):
        calibrate_from(tmp_path / "spheres.csv", tmp_path / "c.toml", 7, datetime.now(UTC))
    assert not (tmp_path / "c.toml").exists()


def test_exit_status_follows_the_verdict() -> None:
    assert command.EXIT == {"PASS": 0, "REPAIR": 10, "SCRAP": 20, "HOLD": 30}
    assert command.summary({"verdict": "REPAIR", "route": "fill", "reasons": ["tip"]}) == "REPAIR fill: tip"
    assert command.summary({"verdict": "HOLD", "route": None, "reasons": []}) == "HOLD: "
    assert json.dumps(command.EXIT)
