"""Rigid motions as 4x4 matrices `T_to_from`, so that neighbours cancel in the reading."""

import numpy as np
from scipy.spatial.transform import Rotation

from geometry.errors import BadInput
from geometry.types import Floats


def rigid(rotation: Floats, translation_mm: Floats) -> Floats:
    """The 4x4 of `x -> rotation @ x + translation_mm`."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation_mm
    return T


def apply(T: Floats, points_mm: Floats) -> Floats:
    """Points (n, 3) moved by `T`."""
    return points_mm @ T[:3, :3].T + T[:3, 3]


def rotate(T: Floats, directions: Floats) -> Floats:
    """Directions (n, 3) turned by `T`, not translated."""
    return directions @ T[:3, :3].T


def inverse(T: Floats) -> Floats:
    """The motion back."""
    R = T[:3, :3]
    return rigid(R.T, -R.T @ T[:3, 3])


def exp(twist: Floats, pivot_mm: Floats) -> Floats:
    """The motion of a twist (rx, ry, rz in rad, tx, ty, tz in mm): turn about `pivot_mm`, then shift."""
    R = Rotation.from_rotvec(twist[:3]).as_matrix()
    return rigid(R, pivot_mm + twist[3:] - R @ pivot_mm)


def log(T: Floats, pivot_mm: Floats) -> Floats:
    """The twist (6,) whose `exp` about `pivot_mm` is `T`."""
    shift_mm = apply(T, pivot_mm[None])[0] - pivot_mm
    return np.concatenate([Rotation.from_matrix(T[:3, :3]).as_rotvec(), shift_mm])


def about_z(angle_deg: float) -> Floats:
    """The turn by `angle_deg` about +Z, counter-clockwise seen from +Z."""
    return rigid(Rotation.from_euler("z", angle_deg, degrees=True).as_matrix(), np.zeros(3))


def check_rigid(T: Floats, name: str) -> None:
    """Raise `BadInput` unless `T` is a proper rigid motion: orthonormal to 1e-9, no scale, det +1."""
    R = T[:3, :3]
    proper = (
        T.shape == (4, 4)
        and bool(np.isfinite(T).all())
        and bool(np.allclose(R @ R.T, np.eye(3), atol=1e-9))
        and float(np.linalg.det(R)) > 0.0
        and bool(np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]))
    )
    if not proper:
        raise BadInput(f"{name}: not a proper rigid motion")
