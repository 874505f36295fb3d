"""A calibration of the turntable's axis: from the centres of a sphere to the file that the station reads."""

from datetime import datetime
from pathlib import Path

import numpy as np

from geometry.calibrate import AxisCalibration, calibrate_axis
from geometry.errors import CannotMeasure
from geometry.types import Floats
from station.clouds import BadScan, read_whole
from station.formats.malformed import Malformed, numbers
from station.tomlfile import BadFile


def calibrate_from(spheres: Path, out: Path, scanner_serial: int, now: datetime) -> str:
    """One line that says what was found, once `out` is written; raises `BadScan` or `BadFile`."""
    angles_deg, centres_mm = read_spheres(spheres)
    try:
        axis = calibrate_axis(centres_mm, angles_deg)
    except CannotMeasure as error:
        raise BadScan(f"{spheres}: {error}") from error
    try:
        out.write_text(calibration_text(axis, scanner_serial, now), encoding="utf-8")
    except OSError as error:
        raise BadFile(out, error.strerror or "cannot be written") from error
    offset_um, tilt_deg = 1000.0 * axis.sigma_offset_mm, axis.sigma_tilt_deg
    return f"axis known to {offset_um:.1f} um and {tilt_deg:.4f} deg from {len(angles_deg)} angles: {out}"


def read_spheres(path: Path) -> tuple[Floats, Floats]:
    """Angles (k,) in deg and centres (k, 3) in mm of a CSV file with rows `angle_deg, x, y, z`."""
    rows = [row for row in read_whole(path).splitlines() if row.strip() and not row.lstrip().startswith(b"#")]
    try:
        table = numbers(rows, [0, 1, 2, 3], ",")
    except Malformed as error:
        raise BadScan(f"{path}: {error}") from error
    if not rows or not np.isfinite(table).all():
        raise BadScan(f"{path}: wants finite rows `angle_deg, x, y, z`")
    return table[:, 0], table[:, 1:]


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
