"""The best fit of a section to its nominal in the plane, with weights and locks."""

from dataclasses import dataclass

import numpy as np

from geometry.kernels.profile import nearest_nodes
from geometry.sections.chart import FitSettings, Freedom, outward_normals
from geometry.sections.curve import Estimate, centroid, node_shares
from geometry.types import Floats, Ints

_FREEDOMS: tuple[Freedom, ...] = ("x", "y", "rotation")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SectionFit:
    """The motion that takes the nominal onto the section, and what it leaves.

    `x`, `y` (mm) move the nominal's centroid, `rotation` (rad, counter-clockwise) turns about it; a locked
    one is 0 with no gradient. `form_mm` (m,) is the signed distance of the section, moved back, to the
    nominal.
    """

    x: Estimate
    y: Estimate
    rotation: Estimate
    form_mm: Floats
    columns: Floats  # (m, 3): growth of the distance with x, y and rotation

    def form_gradient(self, node: int) -> Floats:
        """Growth (m,) of the form deviation of one node with the displacement of every node."""
        gradient: Floats = -(
            self.columns[node] @ np.stack([e.gradient for e in (self.x, self.y, self.rotation)])
        )
        gradient[node] += 1.0
        return gradient


def best_fit(curve_mm: Floats, nominal_mm: Floats, side: Ints, settings: FitSettings) -> SectionFit:
    """The motion of least squared distance to the nominal, every mm of arc weighing as much as its side.

    `side` (m,) as in `NominalSection`. What is locked does not move. Distances are along the normals of the
    nominal (point to plane).
    """
    home, normals = centroid(nominal_mm), outward_normals(nominal_mm)
    weight = node_shares(curve_mm) * settings.weights[side]
    free = np.array([name not in settings.locked for name in _FREEDOMS])
    motion = np.zeros(3)
    for _ in range(12):
        back = _undo(curve_mm, home, motion)
        near = nearest_nodes(back, nominal_mm)
        distance = ((back - nominal_mm[near]) * normals[near]).sum(axis=1)
        columns = _columns(back - home, normals[near])
        pull = np.zeros((3, len(curve_mm)))
        weighted = columns[:, free].T * weight
        pull[free] = np.linalg.lstsq(weighted @ columns[:, free], weighted)[0]
        step = pull @ distance
        if np.abs(step).max() < 1e-9:
            break
        motion = motion + step
    x, y, rotation = (Estimate(value=float(v), gradient=g) for v, g in zip(motion, pull, strict=True))
    return SectionFit(x=x, y=y, rotation=rotation, form_mm=distance, columns=columns)


def _undo(curve_mm: Floats, home_mm: Floats, motion: Floats) -> Floats:
    """The curve with a motion (x, y, rotation about `home_mm`) taken back."""
    c, s = np.cos(motion[2]), np.sin(motion[2])
    back: Floats = home_mm + (curve_mm - home_mm - motion[:2]) @ np.array([[c, -s], [s, c]])
    return back


def _columns(arm_mm: Floats, normals: Floats) -> Floats:
    lever = normals[:, 1] * arm_mm[:, 0] - normals[:, 0] * arm_mm[:, 1]
    return np.column_stack([normals, lever])
