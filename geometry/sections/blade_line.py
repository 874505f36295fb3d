"""What the sections of one blade say together: lean, bow, and twist from each section to the next."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from geometry.errors import BadInput
from geometry.registration.alignment import Alignment, pose_covariance
from geometry.sections.airfoil import Section, Stacking
from geometry.types import Floats, Measurand, Measured, NotMeasured, Unit


@dataclass(frozen=True, slots=True, kw_only=True)
class Judged:
    """A measured value beside its nominal one; both are there or neither."""

    measured: Measured
    nominal: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class RelativeTwist:
    """The twist between two neighbouring sections."""

    z_mm: tuple[float, float]
    twist_deg: Judged


@dataclass(frozen=True, slots=True, kw_only=True)
class BladeLine:
    """Parameters of the line on which the sections are stacked.

    `lean_x_deg`, `lean_y_deg`: the angle against Z of the least-squares line through the centroids, seen in
    the plane of X and Z, and of Y and Z; positive where x or y grows with z.
    `bow_mm`: the largest distance, in the planes of the sections, of a centroid from the straight line
    that joins the first and the last one.
    `relative_twist`: how much more than its nominal each section is turned than the one below it,
    counter-clockwise about +Z; nominal 0.
    """

    lean_x_deg: Judged
    lean_y_deg: Judged
    bow_mm: Judged
    relative_twist: tuple[RelativeTwist, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Stack:
    """Sections with both position and orientation, upward: their values and one covariance for all."""

    z_mm: Floats  # (n,)
    measured: Floats  # (n, 3)
    nominal: Floats  # (n, 3)
    covariance: Floats  # (3 n, 3 n)

    def judged(self, name: str, unit: Unit, values: tuple[float, float], gradient: Floats) -> Judged:
        """A measured and a nominal value, with the sigma that the growth (n, 3) gives."""
        flat = gradient.ravel()
        sigma = float(np.sqrt(max(float(flat @ self.covariance @ flat), 0.0)))
        return Judged(
            measured=Measurand(name=name, value=values[0], sigma=sigma, unit=unit), nominal=values[1]
        )


def blade_line(sections: Sequence[Section], alignment: Alignment) -> BladeLine:
    """Lean, bow and relative twist of the sections, in whatever order they come.

    Lean needs two sections with a position, bow three; a section that lacks it is left out of neither
    silently: then there is no number. Sigmas hold the points of each section, taken as independent of the
    others', and the pose that all share.
    """
    upward = sorted(sections, key=lambda section: section.z_mm)
    if any(not below.z_mm < above.z_mm for below, above in pairwise(upward)):
        raise BadInput("blade line: two sections have the same height")
    twist = tuple(_relative_twist(below, above, alignment) for below, above in pairwise(upward))
    why = _lacking(upward)
    if why is not None or len(upward) < 2:
        absent = Judged(measured=why or NotMeasured(reason="fewer than two sections"), nominal=None)
        return BladeLine(lean_x_deg=absent, lean_y_deg=absent, bow_mm=absent, relative_twist=twist)
    stack = _stack(upward, alignment)
    return BladeLine(
        lean_x_deg=_lean(stack, 0), lean_y_deg=_lean(stack, 1), bow_mm=_bow(stack), relative_twist=twist
    )


def _lacking(sections: Sequence[Section]) -> NotMeasured | None:
    """Why the sections have no line: one is not whole; for damage only if that holds for all that are not."""
    why = None
    for section in sections:
        if section.stacking is None:
            lost = section.measurands.get("position_mm")
            damaged = isinstance(lost, NotMeasured) and lost.in_damage
            if why is None or not damaged:
                reason = f"the section at z = {section.z_mm:g} mm has no position"
                why = NotMeasured(reason=reason, in_damage=damaged)
    return why


def _stack(sections: Sequence[Section], alignment: Alignment) -> _Stack:
    stackings = [section.stacking for section in sections if section.stacking is not None]
    pose = np.vstack([stacking.pose for stacking in stackings])
    covariance = pose @ pose_covariance(alignment) @ pose.T
    for i, stacking in enumerate(stackings):
        own = slice(3 * i, 3 * i + 3)
        covariance[own, own] += stacking.covariance
    return _Stack(
        z_mm=np.array([section.z_mm for section in sections]),
        measured=_values(stackings, "measured"),
        nominal=_values(stackings, "nominal"),
        covariance=covariance,
    )


def _values(stackings: Sequence[Stacking], name: str) -> Floats:
    return np.stack([getattr(stacking, name) for stacking in stackings])


def _lean(stack: _Stack, axis: int) -> Judged:
    """The lean along x (0) or y (1)."""
    arm = stack.z_mm - stack.z_mm.mean()
    weight = arm / float(arm @ arm)
    slope, nominal = float(weight @ stack.measured[:, axis]), float(weight @ stack.nominal[:, axis])
    gradient = np.zeros_like(stack.measured)
    gradient[:, axis] = np.rad2deg(weight / (1.0 + slope**2))
    values = float(np.rad2deg(np.arctan(slope))), float(np.rad2deg(np.arctan(nominal)))
    return stack.judged(f"lean_{'xy'[axis]}_deg", "deg", values, gradient)


def _bow(stack: _Stack) -> Judged:
    """The bow; as a vector in the plane it is linear, and its length is taken where it is longest."""
    if len(stack.z_mm) < 3:
        return Judged(measured=NotMeasured(reason="fewer than three sections"), nominal=None)
    up = (stack.z_mm - stack.z_mm[0]) / (stack.z_mm[-1] - stack.z_mm[0])
    measured, nominal = (_off_line(values[:, :2], up) for values in (stack.measured, stack.nominal))
    size = np.linalg.norm(measured, axis=1)
    widest = 1 + int(np.argmax(size[1:-1]))
    bow = float(size[widest])
    away = measured[widest] / bow if bow > 0.0 else np.array([1.0, 0.0])
    gradient = np.zeros_like(stack.measured)
    gradient[widest, :2] += away
    gradient[0, :2] -= (1.0 - up[widest]) * away
    gradient[-1, :2] -= up[widest] * away
    values = bow, float(np.linalg.norm(nominal, axis=1).max())
    return stack.judged("bow_mm", "mm", values, gradient)


def _off_line(centroids_mm: Floats, up: Floats) -> Floats:
    """(n, 2): each centroid against the line from the first to the last."""
    line: Floats = centroids_mm[0] + up[:, None] * (centroids_mm[-1] - centroids_mm[0])
    return centroids_mm - line


def _relative_twist(below: Section, above: Section, alignment: Alignment) -> RelativeTwist:
    z_mm = below.z_mm, above.z_mm
    why = _lacking((below, above))
    if why is not None:
        return RelativeTwist(z_mm=z_mm, twist_deg=Judged(measured=why, nominal=None))
    stack = _stack((below, above), alignment)
    gradient = np.zeros((2, 3))
    gradient[:, 2] = np.rad2deg([-1.0, 1.0])
    twist = float(np.rad2deg(stack.measured[1, 2] - stack.measured[0, 2]))
    return RelativeTwist(
        z_mm=z_mm, twist_deg=stack.judged("relative_twist_deg", "deg", (twist, 0.0), gradient)
    )
