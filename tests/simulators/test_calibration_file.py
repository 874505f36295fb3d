"""The calibration that the simulated cell hands out."""

import tomllib
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from simulators.calibration_file import calibrated_axis, write_calibration
from simulators.rig import Rig, inverse, rig_around

RIG: Rig = rig_around(radius_mm=27.0, low_mm=20.0, high_mm=120.0, pitch_mm=0.3, seat_mm=20.0, seed=1)


def test_the_file_has_the_agreed_keys(tmp_path: Path) -> None:
    path = tmp_path / "calibration.toml"
    write_calibration(path, RIG, 5, datetime(2026, 3, 1, 12, 30, tzinfo=UTC))
    document = tomllib.loads(path.read_text())
    assert document["schema"] == "bladecell.calibration/1"
    assert document["created_utc"] == "2026-03-01T12:30:00Z"
    assert document["scanner_serial"] == 93111
    assert document["sigma_axis_offset_mm"] == 0.003
    assert document["sigma_axis_tilt_deg"] == 0.002
    assert np.array(document["T_scanner_table0"]) == pytest.approx(calibrated_axis(RIG, 5), abs=0.0)


def test_the_estimate_errs_by_the_stated_sigmas_and_only_in_the_axis() -> None:
    errors = np.array([inverse(RIG.T_scanner_table0) @ calibrated_axis(RIG, seed) for seed in range(400)])
    assert errors[:, :2, 3].std() == pytest.approx(0.003, rel=0.1)
    assert np.degrees(errors[:, :2, 2]).std() == pytest.approx(0.002, rel=0.1)
    assert np.abs(errors[:, 2, 3]).max() < 1e-12
    assert np.abs(errors[:, 1, 0]).max() < 1e-8


def test_the_estimate_is_seeded() -> None:
    assert np.array_equal(calibrated_axis(RIG, 1), calibrated_axis(RIG, 1))
    assert not np.array_equal(calibrated_axis(RIG, 1), calibrated_axis(RIG, 2))
