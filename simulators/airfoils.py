"""Where the airfoil of a closed mesh is: its span, its edge lines and its two sides, from plane sections."""

from dataclasses import dataclass
from math import isfinite

import numpy as np

from simulators.sections import chord_ends_mm, resampled
from simulators.solids import Floats, NotASolid, Solid, loop_area_mm2, slice_loops

LEVELS = 140  # slices in which the platform is looked for
EDGE_LEVELS = 41
JUMP = 6.0  # times the usual growth of a section's area from one slice to the next


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Airfoil:
    """The airfoil of `solid` between `z_min_mm` and its tip face `z_max_mm`, span along +Z.

    `seat_mm`: what lies below stands in the fixture. `le_mm`, `te_mm` (k, 3): edge lines, z ascending,
    ends of the caliper chord of each section; the leading edge is the thicker one on average.
    """

    solid: Solid
    z_min_mm: float
    z_max_mm: float
    seat_mm: float
    le_mm: Floats
    te_mm: Floats

    def __post_init__(self) -> None:
        order = (self.seat_mm, self.z_min_mm, self.z_max_mm)
        if not (all(map(isfinite, order)) and self.seat_mm <= self.z_min_mm < self.z_max_mm):
            raise NotASolid(f"airfoil: fixture, z_min and z_max are {order} mm, want them ascending")

    @property
    def span_mm(self) -> float:
        """The length of the airfoil along z."""
        return self.z_max_mm - self.z_min_mm

    @property
    def chord_mm(self) -> float:
        """The mean caliper chord."""
        return float(np.linalg.norm(self.te_mm - self.le_mm, axis=1).mean())

    def height_mm(self, fraction: float) -> float:
        """The z at a fraction of the span."""
        return self.z_min_mm + fraction * self.span_mm

    def edge_points_mm(self, z_mm: float) -> tuple[Floats, Floats]:
        """The leading and the trailing edge point (3,) at `z_mm`."""
        return _on_line(self.le_mm, z_mm), _on_line(self.te_mm, z_mm)

    def frame(self, z_mm: float) -> "SectionFrame":
        """The chord frame of the section at `z_mm`."""
        le, te = self.edge_points_mm(z_mm)
        toward_te = (te - le)[:2] / np.linalg.norm(te - le)
        curve = airfoil_loop(self.solid, min(z_mm, _below_tip_mm(self.z_min_mm, self.z_max_mm)))
        across = np.array([-toward_te[1], toward_te[0]])
        bulge = float(((curve - le[:2]) @ across).mean())
        return SectionFrame(
            curve_mm=curve, le_mm=le, te_mm=te, toward_te=toward_te, toward_suction=across * np.sign(bulge)
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SectionFrame:
    """One section with its edge points (3,) and unit directions (2,) along and across the chord."""

    curve_mm: Floats
    le_mm: Floats
    te_mm: Floats
    toward_te: Floats
    toward_suction: Floats

    def pressure_point_mm(self, chord_fraction: float) -> Floats:
        """The point (3,) on the pressure side at a fraction of the chord from the leading edge."""
        return self._side_point_mm(chord_fraction, -1.0)

    def suction_point_mm(self, chord_fraction: float) -> Floats:
        """The point (3,) on the suction side at a fraction of the chord from the leading edge."""
        return self._side_point_mm(chord_fraction, 1.0)

    def _side_point_mm(self, chord_fraction: float, side: float) -> Floats:
        chord = float(np.linalg.norm(self.te_mm - self.le_mm))
        dense = resampled(self.curve_mm, chord / 4000.0)
        along = (dense - self.le_mm[:2]) @ self.toward_te
        near = np.flatnonzero(np.abs(along - chord_fraction * chord) < chord / 2000.0)
        height = side * (dense[near] @ self.toward_suction)
        return np.append(dense[near[height.argmax()]], self.le_mm[2])


def _on_line(line_mm: Floats, z_mm: float) -> Floats:
    return np.array([np.interp(z_mm, line_mm[:, 2], line_mm[:, axis]) for axis in range(2)] + [z_mm])


def airfoil_loop(solid: Solid, z_mm: float) -> Floats:
    """The largest loop (m, 2) of the section at `z_mm`, counter-clockwise. Raises `NotASolid`."""
    loops = slice_loops(solid, z_mm)
    if not loops:
        raise NotASolid(f"the plane z = {z_mm:.3f} mm does not cut the mesh")
    return max(loops, key=loop_area_mm2)


def find_airfoil(solid: Solid, z_min_mm: float | None = None, z_max_mm: float | None = None) -> Airfoil:
    """The airfoil of a blade that stands on its root with the tip at the largest z.

    Without `z_min_mm` the platform is where the area of the sections, going down from the tip, leaves
    its usual growth; 4 % of the span above it the fillet is over. A mesh without a platform is all
    airfoil, and its lowest part stands in the fixture.
    """
    bottom, top = (float(end) for end in (solid.vertices_mm[:, 2].min(), solid.vertices_mm[:, 2].max()))
    z_max = top if z_max_mm is None else z_max_mm
    if z_min_mm is None:
        platform = _platform_mm(solid, bottom, top)
        low, rise = (bottom, 0.05) if platform is None else (platform, 0.04)
        z_min = low + rise * (z_max - low)
    else:
        z_min = z_min_mm
    if not bottom <= z_min < z_max <= top:
        raise NotASolid(
            f"airfoil: z {z_min:g} to {z_max:g} mm is not within the mesh, {bottom:g} to {top:g} mm"
        )
    seat = z_min - 0.01 * (z_max - z_min)
    le, te = _edge_lines(solid, z_min, z_max)
    return Airfoil(solid=solid, z_min_mm=z_min, z_max_mm=z_max, seat_mm=seat, le_mm=le, te_mm=te)


def _platform_mm(solid: Solid, bottom: float, top: float) -> float | None:
    levels = np.linspace(top, bottom, LEVELS + 2)[1:-1]
    areas = np.array([loop_area_mm2(airfoil_loop(solid, float(z))) for z in levels])
    growth = np.abs(np.diff(np.log(areas)))
    usual = float(np.median(growth[: LEVELS // 4]))
    jumps = np.flatnonzero(growth > max(JUMP * usual, 0.05))
    return float(levels[jumps[0]]) if len(jumps) else None


def _below_tip_mm(z_min: float, z_max: float) -> float:
    """The highest plane that surely cuts the whole section: a worn tip face is not quite level."""
    return z_max - 0.02 * (z_max - z_min)


def _edge_lines(solid: Solid, z_min: float, z_max: float) -> tuple[Floats, Floats]:
    levels = np.linspace(z_min, _below_tip_mm(z_min, z_max), EDGE_LEVELS)
    curves = [airfoil_loop(solid, float(z)) for z in levels]
    first: list[Floats] = []
    second: list[Floats] = []
    for curve in curves:
        a, b = chord_ends_mm(curve)
        if first and np.linalg.norm(a - first[-1]) > np.linalg.norm(b - first[-1]):
            a, b = b, a
        first.append(a)
        second.append(b)
    fatter = sum(
        _end_width(c, a, b) - _end_width(c, b, a) for c, a, b in zip(curves, first, second, strict=True)
    )
    le, te = (first, second) if fatter > 0.0 else (second, first)
    return _to_tip(np.column_stack([le, levels]), z_max), _to_tip(np.column_stack([te, levels]), z_max)


def _to_tip(line_mm: Floats, z_max: float) -> Floats:
    """The line with its last piece drawn on, straight, to the tip."""
    first, last = line_mm[-4], line_mm[-1]
    tip = last + (last - first) * (z_max - last[2]) / (last[2] - first[2])
    return np.vstack([line_mm, tip])


def _end_width(curve_mm: Floats, end: Floats, other: Floats) -> float:
    chord = float(np.linalg.norm(other - end))
    along = (other - end) / chord
    dense = resampled(curve_mm, chord / 2000.0) - end
    near = np.abs(dense @ along - 0.04 * chord) < 0.005 * chord
    return float(np.ptp(dense[near] @ np.array([-along[1], along[0]])))
