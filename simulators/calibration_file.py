"""The axis calibration file of a simulated cell: what a calibration would give, apart from the truth."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from simulators.rig import Rig
from simulators.solids import Floats

SIGMA_AXIS_OFFSET_MM = 0.003
SIGMA_AXIS_TILT_DEG = 0.002


def calibrated_axis(rig: Rig, seed: int) -> Floats:
    """The estimate of `T_scanner_table0` (4x4): the truth, its axis shifted and tilted by a seeded draw.

    The rotation about the axis and the height along it are no property of the axis; they keep the truth.
    """
    rng = np.random.default_rng([seed, 4711])
    error = np.eye(4)
    tilt = np.append(rng.normal(0.0, np.radians(SIGMA_AXIS_TILT_DEG), 2), 0.0)
    error[:3, :3] = Rotation.from_rotvec(tilt).as_matrix()
    error[:2, 3] = rng.normal(0.0, SIGMA_AXIS_OFFSET_MM, 2)
    estimate: Floats = rig.T_scanner_table0 @ error
    return estimate


def write_calibration(path: Path, rig: Rig, seed: int, created_utc: datetime | None = None) -> None:
    """Write the calibration of this rig as TOML, dated now unless told otherwise."""
    created = created_utc or datetime.now(UTC)
    rows = ",\n".join(f"  {[float(value) for value in row]!r}" for row in calibrated_axis(rig, seed))
    path.write_text(
        'schema = "bladecell.calibration/1"\n'
        f'created_utc = "{created.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")}"\n'
        f"scanner_serial = {rig.scanner_serial}\n"
        f"sigma_axis_offset_mm = {SIGMA_AXIS_OFFSET_MM}\n"
        f"sigma_axis_tilt_deg = {SIGMA_AXIS_TILT_DEG}\n"
        f"T_scanner_table0 = [\n{rows},\n]\n",
        encoding="utf-8",
    )
