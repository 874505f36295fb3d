"""Where the scanner stands before the turntable.

Frames. "table": z is the rotation axis, up; a positive angle turns the part counter-clockwise seen from
above. "scanner": origin where the optical axis meets the working distance, z toward the camera, x along
the baseline. `x_scanner = T_scanner_table0 @ Rz(angle) @ x_table`.
"""

from dataclasses import dataclass
from math import isfinite

import numpy as np
from scipy.spatial.transform import Rotation

from simulators.solids import Floats


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rig:
    """The true geometry of scanner and turntable.

    The camera stands at (0, 0, standoff), the projector at (baseline, 0, standoff) of the scanner
    frame, both looking at its origin; `pitch_mm` is the width of a pixel there. Table points below
    `seat_mm` stand in a black fixture and are not measured.
    """

    T_scanner_table0: Floats
    standoff_mm: float
    baseline_mm: float
    pitch_mm: float
    rows: int
    columns: int
    seat_mm: float
    scanner_serial: int = 93111

    def __post_init__(self) -> None:
        sizes = (self.standoff_mm, self.baseline_mm, self.pitch_mm, float(self.rows), float(self.columns))
        if not all(isfinite(size) and size > 0.0 for size in sizes):
            raise ValueError(f"rig: standoff, baseline, pitch and pixels {sizes} are not positive")
        R = self.T_scanner_table0[:3, :3]
        if not (np.allclose(R @ R.T, np.eye(3), atol=1e-9) and np.linalg.det(R) > 0.0):
            raise ValueError("rig: T_scanner_table0 is not a rigid motion")

    @property
    def camera_mm(self) -> Floats:
        """The centre of the camera, scanner frame."""
        return np.array([0.0, 0.0, self.standoff_mm])

    @property
    def projector_mm(self) -> Floats:
        """The centre of the projector, scanner frame."""
        return np.array([self.baseline_mm, 0.0, self.standoff_mm])

    def directions(self) -> Floats:
        """The unit directions (rows, columns, 3) of the camera's pixels, scanner frame."""
        x = (np.arange(self.columns) - 0.5 * (self.columns - 1)) * self.pitch_mm
        y = (0.5 * (self.rows - 1) - np.arange(self.rows)) * self.pitch_mm
        rays = np.stack(np.broadcast_arrays(x, y[:, None], -self.standoff_mm), axis=-1)
        return rays / np.linalg.norm(rays, axis=-1)[..., None]


def rig_around(
    *, radius_mm: float, low_mm: float, high_mm: float, pitch_mm: float, seat_mm: float, seed: int
) -> Rig:
    """A rig that sees a cylinder about the table's axis whole, from 35 degrees above.

    `seed` sets the small misalignments of a real installation: nothing stands exactly where drawn.
    """
    rng = np.random.default_rng([seed, 35])
    elevation = np.radians(35.0)
    tall = (high_mm - low_mm) * np.cos(elevation) + 2.0 * radius_mm * np.sin(elevation)
    standoff = 3.0 * max(tall, 2.0 * radius_mm)
    spread = 1.0 + (radius_mm + 0.5 * (high_mm - low_mm)) / standoff
    return Rig(
        T_scanner_table0=_looking_down(elevation, 0.5 * (low_mm + high_mm), standoff, rng),
        standoff_mm=standoff,
        baseline_mm=0.28 * standoff,
        pitch_mm=pitch_mm,
        rows=int(np.ceil(1.1 * tall * spread / pitch_mm)),
        columns=int(np.ceil(2.2 * radius_mm * spread / pitch_mm)),
        seat_mm=seat_mm,
    )


def _looking_down(elevation: float, centre_mm: float, standoff_mm: float, rng: np.random.Generator) -> Floats:
    up, back = np.sin(elevation), np.cos(elevation)
    axes = np.array([[1.0, 0.0, 0.0], [0.0, up, back], [0.0, -back, up]])  # rows: scanner x, y, z in table
    small = Rotation.from_rotvec(rng.normal(0.0, np.radians(0.4), 3)).as_matrix()
    T = np.eye(4)
    T[:3, :3] = small @ axes
    T[:3, 3] = -T[:3, :3] @ np.array([0.0, 0.0, centre_mm]) + rng.normal(0.0, 0.002 * standoff_mm, 3)
    return T


def about_z(angle_deg: float) -> Floats:
    """The turn by `angle_deg` about the table's axis, counter-clockwise seen from above."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", angle_deg, degrees=True).as_matrix()
    return T


def apply(T: Floats, points: Floats) -> Floats:
    """Points (n, 3) moved by `T`."""
    return points @ T[:3, :3].T + T[:3, 3]


def inverse(T: Floats) -> Floats:
    """The motion back."""
    back = np.eye(4)
    back[:3, :3] = T[:3, :3].T
    back[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return back
