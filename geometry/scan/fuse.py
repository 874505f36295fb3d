"""Views + axis calibration -> one cloud."""

from collections.abc import Sequence

import numpy as np

from geometry.errors import CannotMeasure
from geometry.scan.calibrate import AxisCalibration
from geometry.transforms import about_z, apply, inverse
from geometry.types import Cloud, View


def fuse(views: Sequence[View], axis: AxisCalibration, sigma_mm: float) -> Cloud:
    """The points of all views in the table frame at 0 deg, in the order given.

    `sigma_mm` is the standard uncertainty of a point along the surface normal. Raises `CannotMeasure`
    without a point.
    """
    moved = [apply(inverse(axis.T_scanner_table0 @ about_z(v.angle_deg)), v.points_mm) for v in views]
    points_mm = np.concatenate([np.zeros((0, 3)), *moved])
    if len(points_mm) == 0:
        raise CannotMeasure(f"{len(views)} views without a point")
    return Cloud(
        points_mm=points_mm,
        sigma_mm=np.full(len(points_mm), sigma_mm),
        view=np.repeat([v.index for v in views], [len(v.points_mm) for v in views]).astype(np.int64),
    )
