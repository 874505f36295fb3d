"""The daily check with a ball bar: what it finds, and for how long its gate stays shut."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from typer.testing import CliRunner

from station.__main__ import app
from station.calibration import check_from
from station.clouds import BadScan
from station.config import StationConfig, read_config
from station.daily import daily_gate
from station.gates import Gate

CALIBRATION = """
schema = "bladecell.calibration/1"
created_utc = 2026-01-01T00:00:00Z
T_scanner_table0 = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
sigma_axis_offset_mm = 0.003
sigma_axis_tilt_deg = 0.002
scanner_serial = 7
"""
SHIPPED = Path(__file__).parents[2] / "config/station.toml"
BAR = "".join(
    f"{angle}, {r * c}, {r * s}, 10.0, {ball}\n"
    for angle, c, s in [(0, 1, 0), (90, 0, 1), (180, -1, 0), (270, 0, -1)]
    for ball, r in [(1, 30.0), (2, 80.0)]
)


def test_a_daily_check_holds_its_gate_for_a_day(tmp_path: Path) -> None:
    (tmp_path / "spheres.csv").write_text(BAR)
    (tmp_path / "calibration.toml").write_text(CALIBRATION)
    names = ("spheres.csv", "calibration.toml", "daily.toml")
    spheres, calibration, out = (str(tmp_path / name) for name in names)
    done = CliRunner().invoke(
        app, ["calibrate", "--spheres", spheres, "--check", calibration, "--bar-mm", "50.02", "--out", out]
    )
    assert done.exit_code == 0, done.output
    assert "bar -0.0200 mm off 50.02 mm" in done.output
    now = datetime.now(UTC)

    def gate(serial: int, max_error_mm: float, later_h: float = 0.0) -> Gate:
        text = SHIPPED.read_text().replace("serial = 93111", f"serial = {serial}")
        text = text.replace("max_error_mm = 0.02", f"max_error_mm = {max_error_mm}")
        (tmp_path / "station.toml").write_text(text)
        return daily_gate(read_config(tmp_path / "station.toml"), now + timedelta(hours=later_h))

    assert gate(7, 0.021).holds
    assert gate(7, 0.019).reason == "off by 0.0200 mm, want at most 0.019 mm"
    assert not gate(8, 0.021).holds
    assert not gate(7, 0.021, later_h=25.0).holds
    assert not gate(7, 0.021, later_h=-1.0).holds
    assert daily_gate(without_table(tmp_path), now).holds
    (tmp_path / "daily.toml").unlink()
    assert "No such file" in gate(7, 0.021).reason


def without_table(folder: Path) -> StationConfig:
    before, _, after = SHIPPED.read_text().partition("[daily_check]")
    (folder / "plain.toml").write_text(before + after[after.index("[worker]") :])
    return read_config(folder / "plain.toml")


@pytest.mark.parametrize(
    "rows", [BAR.replace(", 2\n", ", 1\n"), BAR.splitlines()[0], BAR.replace(", 2\n", ", 0\n")]
)
def test_a_check_that_shows_no_bar_is_refused(tmp_path: Path, rows: str) -> None:
    (tmp_path / "spheres.csv").write_text(rows)
    (tmp_path / "calibration.toml").write_text(CALIBRATION)
    with pytest.raises(BadScan):
        check_from(
            tmp_path / "spheres.csv",
            tmp_path / "calibration.toml",
            50.0,
            tmp_path / "d.toml",
            datetime.now(UTC),
        )
    assert not (tmp_path / "d.toml").exists()
