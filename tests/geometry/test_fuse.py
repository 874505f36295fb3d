"""Views fall on each other when the axis is right."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from geometry.errors import CannotMeasure
from geometry.scan.calibrate import AxisCalibration
from geometry.scan.fuse import fuse
from geometry.transforms import about_z, apply, rigid
from geometry.types import View
from tests.geometry import blades

AXIS = AxisCalibration(
    T_scanner_table0=rigid(
        Rotation.from_euler("x", 90.0, degrees=True).as_matrix(), np.array([2.0, 3.0, 300.0])
    ),
    sigma_offset_mm=0.002,
    sigma_tilt_deg=0.001,
)
ANGLES_DEG = np.arange(0.0, 360.0, 45.0)


def views(rng, noise_mm, shifts_mm):
    """Each view sees the surface that faces the scanner; `shifts_mm` moves a view in the scanner frame."""
    seen = []
    scan = blades.with_noise(blades.scan(blades.Blade(), 12.0, rng), noise_mm, rng)
    share = rng.integers(len(ANGLES_DEG), size=len(scan.points_mm))
    for index, angle_deg in enumerate(ANGLES_DEG):
        T_scanner_table = AXIS.T_scanner_table0 @ about_z(angle_deg)
        facing = (scan.normals @ T_scanner_table[:3, :3].T @ [0.0, 0.0, -1.0] > 0.2) & (share == index)
        points = apply(T_scanner_table, scan.points_mm[facing]) + shifts_mm.get(index, np.zeros(3))
        seen.append(View(index=index, angle_deg=angle_deg, points_mm=points))
    return seen


def test_views_land_on_the_blade_in_the_table_frame_in_order():
    rng = np.random.default_rng(1)
    taken = views(rng, 0.0, {})
    cloud = fuse(taken, AXIS, 0.015)
    assert np.array_equal(np.unique(cloud.view), np.arange(8))
    assert (np.diff(cloud.view) >= 0).all()
    assert (cloud.sigma_mm == 0.015).all()
    first = apply(np.linalg.inv(AXIS.T_scanner_table0 @ about_z(45.0)), taken[1].points_mm)
    assert np.abs(cloud.points_mm[cloud.view == 1] - first).max() < 1e-9
    assert 0.0 <= cloud.points_mm[:, 2].min() < cloud.points_mm[:, 2].max() <= 105.0


def test_no_points_are_no_cloud():
    empty = View(index=0, angle_deg=0.0, points_mm=np.zeros((0, 3)))
    with pytest.raises(CannotMeasure, match="without a point"):
        fuse([empty], AXIS, 0.015)
    with pytest.raises(CannotMeasure, match="without a point"):
        fuse([], AXIS, 0.015)
