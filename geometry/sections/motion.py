"""How the section of a part is moved against the nominal one: bent and untwisted in service."""

from dataclasses import dataclass

import numpy as np

from geometry.kernels.profile import undo_motion
from geometry.robust import TUKEY, biweight, spread
from geometry.sections.chart import Chart
from geometry.types import Floats

_POINTS = 2000  # tell a motion as well as all do


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion:
    """A rigid motion in the plane about `pivot_mm`, linear in height: (x, y in mm, turn in rad) + slope."""

    pivot_mm: Floats  # (2,)
    z_mm: float
    rest: Floats  # (3,)
    per_mm: Floats  # (3,)

    @property
    def terms(self) -> tuple[Floats, float, Floats, Floats]:
        """What kernels take."""
        return self.pivot_mm, self.z_mm, self.rest, self.per_mm

    def undo(self, points_mm: Floats) -> Floats:
        """Points (n, 3) taken back onto the nominal."""
        return undo_motion(np.ascontiguousarray(points_mm), *self.terms)

    def do(self, curve_mm: Floats) -> Floats:
        """A curve (m, 2) of the section itself, taken onto the part."""
        c, s = np.cos(self.rest[2]), np.sin(self.rest[2])
        x, y = (curve_mm - self.pivot_mm).T
        return np.column_stack([c * x - s * y, s * x + c * y]) + self.pivot_mm + self.rest[:2]


def rigid_columns(points_mm: Floats, normals: Floats, pivot_mm: Floats, height: Floats) -> Floats:
    """(n, 6): growth of the signed distance with the section's shift x, y and turn, and with their slopes."""
    lever = normals[:, 1] * (points_mm[:, 0] - pivot_mm[0]) - normals[:, 0] * (points_mm[:, 1] - pivot_mm[1])
    still = np.column_stack([normals, lever])
    return np.hstack([still, still * height[:, None]])


def find_motion(chart: Chart, points_mm: Floats) -> Motion:
    """How the part's section is moved against the nominal one, robustly.

    In service a blade bends and untwists: taken out first, what is left is small against an edge radius.
    A prior of 1 mm and 0.02 rad, a tenth of it per mm of height, holds what the points do not tell.
    """
    pivot, z_mm = chart.curve_mm.mean(axis=0), chart.section_z_mm
    prior = np.array([1.0, 1.0, 0.02, 0.1, 0.1, 0.002]) ** -2.0
    total = np.zeros(6)
    some = points_mm[:: max(1, len(points_mm) // _POINTS)]
    for _ in range(6):
        motion = Motion(pivot_mm=pivot, z_mm=z_mm, rest=total[:3], per_mm=total[3:])
        back = motion.undo(some)
        foot = chart.project(back)
        residual = foot[:, 1]
        scale = spread(residual) + 1e-6
        weight = biweight(residual, TUKEY * scale) / scale**2
        columns = rigid_columns(back, foot[:, 2:], pivot, back[:, 2] - z_mm)
        normal = columns.T @ (columns * weight[:, None]) + np.diag(prior)
        step = np.linalg.solve(normal, columns.T @ (weight * residual) - prior * total)
        total = total + step
        if np.abs(step[:2]).max() < 1e-4 and abs(step[2]) < 1e-5:
            break
    return Motion(pivot_mm=pivot, z_mm=z_mm, rest=total[:3], per_mm=total[3:])
