"""Calibration of the turntable's axis, and its daily check: from centres of balls to a station's files."""

from datetime import datetime
from pathlib import Path

import numpy as np

from geometry.errors import CannotMeasure
from geometry.scan.calibrate import AxisCalibration, ball_places, calibrate_axis
from geometry.types import Floats, Ints
from station.clouds import BadScan, read_whole
from station.config import read_calibration
from station.formats.malformed import Malformed, numbers
from station.recipe import axis_of
from station.tomlfile import BadFile


def calibrate_from(spheres: Path, out: Path, scanner_serial: int, now: datetime) -> str:
    """One line that says what was found, once `out` is written; raises `BadScan` or `BadFile`."""
    angles_deg, centres_mm, ball = read_spheres(spheres)
    try:
        axis = calibrate_axis(centres_mm[ball == ball[0]], angles_deg[ball == ball[0]])
    except CannotMeasure as error:
        raise BadScan(f"{spheres}: {error}") from error
    write_new(out, calibration_text(axis, scanner_serial, now))
    offset_um, tilt_deg = 1000.0 * axis.sigma_offset_mm, axis.sigma_tilt_deg
    return f"axis known to {offset_um:.1f} um and {tilt_deg:.4f} deg from {len(angles_deg)} angles: {out}"


def check_from(spheres: Path, calibration: Path, bar_mm: float, out: Path, now: datetime) -> str:
    """One line that says what was found, once `out` is written; raises `BadScan` or `BadFile`."""
    known = read_calibration(calibration)
    angles_deg, centres_mm, ball = read_spheres(spheres)
    try:
        places = ball_places(axis_of(known), centres_mm, angles_deg, ball)
        length_mm = _bar_length_mm(places.places_mm)
    except CannotMeasure as error:
        raise BadScan(f"{spheres}: {error}") from error
    text = (
        'schema = "bladecell.daily_check/1"\n'
        f'created_utc = "{now.isoformat(timespec="seconds")}"\n'
        f"scanner_serial = {known.scanner_serial}\n"
        f"stray_mm = {places.stray_mm!r}\n"
        f"length_error_mm = {length_mm - bar_mm!r}\n"
    )
    write_new(out, text)
    return f"balls stray {places.stray_mm:.4f} mm, bar {length_mm - bar_mm:+.4f} mm off {bar_mm:g} mm: {out}"


def _bar_length_mm(places_mm: Floats) -> float:
    if len(places_mm) != 2:
        raise CannotMeasure(f"a ball bar has two balls, not {len(places_mm)}")
    return float(np.linalg.norm(places_mm[1] - places_mm[0]))


def write_new(out: Path, text: str) -> None:
    """Write a file that people asked for; raises `BadFile`."""
    try:
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise BadFile(out, error.strerror or "cannot be written") from error


def read_spheres(path: Path) -> tuple[Floats, Floats, Ints]:
    """Angles (k,) in deg, centres (k, 3) in mm and numbers (k,) of balls, of a CSV file.

    Its rows are `angle_deg, x, y, z`, or `angle_deg, x, y, z, ball` where there is more than one.
    """
    rows = [row for row in read_whole(path).splitlines() if row.strip() and not row.lstrip().startswith(b"#")]
    columns = 5 if rows and rows[0].count(b",") == 4 else 4
    try:
        table = numbers(rows, list(range(columns)), ",")
    except Malformed as error:
        raise BadScan(f"{path}: {error}") from error
    if not rows or not np.isfinite(table).all():
        raise BadScan(f"{path}: wants finite rows `angle_deg, x, y, z` or `angle_deg, x, y, z, ball`")
    ball = table[:, 4] if columns == 5 else np.ones(len(table))
    if not np.array_equal(ball, np.rint(np.clip(ball, 1.0, 99.0))):
        raise BadScan(f"{path}: balls are numbered 1 to 99")
    return table[:, 0], table[:, 1:4], ball.astype(np.int64)


def calibration_text(axis: AxisCalibration, scanner_serial: int, now: datetime) -> str:
    """The calibration file."""
    rows = ",\n".join(f"  [{', '.join(repr(float(x)) for x in row)}]" for row in axis.T_scanner_table0)
    return (
        'schema = "bladecell.calibration/1"\n'
        f'created_utc = "{now.isoformat(timespec="seconds")}"\n'
        f"T_scanner_table0 = [\n{rows},\n]\n"
        f"sigma_axis_offset_mm = {axis.sigma_offset_mm!r}\n"
        f"sigma_axis_tilt_deg = {axis.sigma_tilt_deg!r}\n"
        f"scanner_serial = {scanner_serial}\n"
    )
