"""Airfoils and blades in closed form: the truths that the section tests measure against.

A section is the envelope of discs along a camber line (LE and TE are arcs of exactly known radius, the
largest disc is the maximum thickness), drawn with its own formulas. A blade stacks it with twist, taper
and lean; what it became in service is a smooth deviation along the normals and a rigid motion.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from geometry.blade.nominal import Nominal, NominalSection
from geometry.registration.alignment import Alignment
from geometry.sections.profile import Scan, scan_of
from geometry.types import Bools, Cloud, Floats, Ints
from tests.geometry.poses import in_place


@dataclass(frozen=True, kw_only=True)
class DiscAirfoil:
    """Discs of radius le -> largest -> te along a parabolic camber line from x = 0 to `span_mm`."""

    span_mm: float = 44.0
    camber_mm: float = 4.0
    le_mm: float = 0.8
    te_mm: float = 0.45
    largest_mm: float = 2.6

    def discs(self, t: Floats) -> tuple[Floats, Floats, Floats]:
        """Centres (n, 2), radii and d radius / d t at t in [0, 1]."""
        centre = np.column_stack([self.span_mm * t, 4.0 * self.camber_mm * t * (1.0 - t)])
        bulge = self.largest_mm - 0.5 * (self.le_mm + self.te_mm)
        radius = self.le_mm * (1.0 - t) + self.te_mm * t + bulge * np.sin(np.pi * t) ** 2
        slope = self.te_mm - self.le_mm + bulge * np.pi * np.sin(2.0 * np.pi * t)
        return centre, radius, slope

    def curve(self, per_side: int = 1500, per_edge: int = 400) -> tuple[Floats, int]:
        """Counter-clockwise closed curve (m, 2) from the trailing edge, and the index of the leading edge."""
        t = 0.5 - 0.5 * np.cos(np.pi * np.linspace(0.0, 1.0, per_side))
        centre, radius, slope = self.discs(t)
        tangent = np.column_stack([np.full_like(t, self.span_mm), 4.0 * self.camber_mm * (1.0 - 2.0 * t)])
        speed = np.linalg.norm(tangent, axis=1)
        tangent /= speed[:, None]
        normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
        lean = slope / speed
        root = np.sqrt(1.0 - lean**2)
        upper = centre + radius[:, None] * (root[:, None] * normal - lean[:, None] * tangent)
        lower = centre + radius[:, None] * (-root[:, None] * normal - lean[:, None] * tangent)
        te = _arc(centre[-1], lower[-1], upper[-1], per_edge)
        le = _arc(centre[0], upper[0], lower[0], per_edge)
        middle = per_edge // 2
        curve = np.vstack([te[middle:-1], upper[::-1], le[1:-1], lower, te[1:middle]])
        return curve, (per_edge - middle - 1) + per_side + middle - 1


def random_airfoil(rng: np.random.Generator) -> DiscAirfoil | None:
    """Chord 10 to 100 mm, up to 25 % camber, edges from 0.3 %; None if the discs envelop no simple curve."""
    span = 10.0 ** rng.uniform(1.0, 2.0)
    te = span * rng.uniform(0.003, 0.02)
    le = te * rng.uniform(1.0, 3.0)
    airfoil = DiscAirfoil(
        span_mm=span,
        camber_mm=span * rng.uniform(0.0, 0.25),
        le_mm=le,
        te_mm=te,
        largest_mm=max(le * 1.1, span * rng.uniform(0.02, 0.09)),
    )
    t = np.linspace(0.0, 1.0, 501)
    _, radius, slope = airfoil.discs(t)
    speed = np.hypot(span, 4.0 * airfoil.camber_mm * (1.0 - 2.0 * t))
    bend = 8.0 * airfoil.camber_mm * span / speed**3
    simple = np.abs(slope / speed).max() < 0.9 and (radius * bend).max() < 0.9
    return airfoil if simple else None


def _arc(centre: Floats, start: Floats, stop: Floats, count: int) -> Floats:
    """`count` points counter-clockwise from `start` to `stop` about `centre`."""
    a, b = (np.arctan2(*(p - centre)[::-1]) for p in (start, stop))
    angle = a + np.linspace(0.0, 1.0, count) * ((b - a) % (2.0 * np.pi))
    return centre + np.linalg.norm(start - centre) * np.column_stack([np.cos(angle), np.sin(angle)])


def normals_of(curve: Floats) -> Floats:
    along = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    return np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]


def arc_of(curve: Floats) -> tuple[Floats, float]:
    step = np.linalg.norm(np.roll(curve, -1, axis=0) - curve, axis=1)
    return np.concatenate([[0.0], np.cumsum(step)[:-1]]), float(step.sum())


def centroid_of(curve: Floats) -> Floats:
    x, y = curve.T
    x1, y1 = np.roll(curve, -1, axis=0).T
    cross = x * y1 - x1 * y
    return np.array([((x + x1) * cross).sum(), ((y + y1) * cross).sum()]) / (3.0 * cross.sum())


def section_of(curve: Floats, le: int, z_mm: float) -> NominalSection:
    arc, perimeter = arc_of(curve)
    return NominalSection(
        z_mm=z_mm,
        curve_mm=curve,
        normals=normals_of(curve),
        arc_mm=arc,
        perimeter_mm=perimeter,
        le_index=le,
        te_index=0,
        side=_sides(curve, le),
    )


def _sides(curve: Floats, le: int, edge_mm: float = 3.0) -> Ints:
    """0 leading edge, 1 suction (above the camber line), 2 trailing edge, 3 pressure side."""
    side = np.where(np.arange(len(curve)) <= le, 1, 3)
    side[np.linalg.norm(curve - curve[0], axis=1) <= edge_mm] = 2
    side[np.linalg.norm(curve - curve[le], axis=1) <= edge_mm] = 0
    return side


Deviation = Callable[[Floats, Floats], Floats]  # fraction of the perimeter, z -> mm along the normal


def nothing(s: Floats, z: Floats) -> Floats:
    return np.zeros(np.broadcast_shapes(np.shape(s), np.shape(z)))


@dataclass(frozen=True, kw_only=True)
class Blade:
    """A stack of one airfoil about its centroid, from z = 0 to `height_mm`."""

    airfoil: DiscAirfoil = DiscAirfoil()
    height_mm: float = 105.0
    twist_deg: float = 25.0
    taper: float = 0.12
    lean_mm: float = 0.0

    def section(self, z: float) -> tuple[Floats, int]:
        curve, le = self.airfoil.curve()
        scale = 1.0 - self.taper * z / self.height_mm
        angle = np.deg2rad(self.twist_deg * z / self.height_mm)
        c, s = np.cos(angle), np.sin(angle)
        at = scale * (curve - centroid_of(curve)) @ np.array([[c, s], [-s, c]])
        return at + np.array([0.0, self.lean_mm * (z / self.height_mm) ** 2]), le


@dataclass(frozen=True, kw_only=True)
class Part:
    """A blade as it is: deviation along the normals, then turned (deg) about its centroid and shifted."""

    blade: Blade = Blade()
    deviation: Deviation = nothing
    shift_mm: tuple[float, float] = (0.0, 0.0)
    turn_deg: float = 0.0

    def section(self, z: float) -> Floats:
        """The true curve (m, 2) at the height z."""
        curve, _ = self.blade.section(z)
        arc, perimeter = arc_of(curve)
        curve = curve + normals_of(curve) * self.deviation(arc / perimeter, np.float64(z))[:, None]
        return self._moved(curve)

    def _moved(self, curve: Floats) -> Floats:
        angle = np.deg2rad(self.turn_deg)
        c, s = np.cos(angle), np.sin(angle)
        return curve @ np.array([[c, s], [-s, c]]) + self.shift_mm

    def scan(
        self, rng: np.random.Generator, low_mm: float, high_mm: float, spacing_mm: float, noise_mm: float
    ) -> Floats:
        """Random points (n, 3), one per spacing_mm^2, noise N(0, noise_mm) along random directions."""
        grid, table, perimeter_mm = _tables(self.blade, low_mm, high_mm)
        count = rng.poisson((high_mm - low_mm) * perimeter_mm / spacing_mm**2)
        z = rng.uniform(low_mm, high_mm, count)
        s = rng.random(count)
        layer = np.clip(np.searchsorted(grid, z) - 1, 0, len(grid) - 2)
        up = (z - grid[layer]) / (grid[1] - grid[0])
        at = s * 20000
        i = at.astype(np.int64)
        f = (at - i)[:, None]
        low = table[layer, i] * (1.0 - f) + table[layer, i + 1] * f
        high = table[layer + 1, i] * (1.0 - f) + table[layer + 1, i + 1] * f
        both = low * (1.0 - up[:, None]) + high * up[:, None]
        curve = both[:, :2] + both[:, 2:] * self.deviation(s, z)[:, None]
        points = np.column_stack([self._moved(curve), z])
        direction = rng.normal(size=points.shape)
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        return points + direction * rng.normal(0.0, noise_mm, count)[:, None]


@cache
def _tables(blade: Blade, low_mm: float, high_mm: float) -> tuple[Floats, Floats, float]:
    """Heights (25,), curve and normals (25, 20001, 4) at even fractions of the perimeter, first perimeter."""
    grid = np.linspace(low_mm, high_mm, 25)
    curves = [blade.section(float(z))[0] for z in grid]
    fine = np.linspace(0.0, 1.0, 20001)
    return grid, np.stack([_table(c, arc_of(c), fine) for c in curves]), arc_of(curves[0])[1]


def _table(curve: Floats, arc: tuple[Floats, float], fine: Floats) -> Floats:
    """Curve and unit normals (k, 4) at the fractions `fine` of the perimeter."""
    s = np.append(arc[0] / arc[1], 1.0)
    columns = np.column_stack([curve, normals_of(curve)])
    closed = np.vstack([columns, columns[:1]])
    out = np.column_stack([np.interp(fine, s, c) for c in closed.T])
    out[:, 2:] /= np.linalg.norm(out[:, 2:], axis=1)[:, None]
    return out


class AnalyticNominal(Nominal):
    """The nominal of a `Blade`, from its formulas instead of a mesh."""

    def __init__(self, blade: Blade) -> None:
        self.blade = blade
        self.z_min_mm = 0.0
        self.z_max_mm = blade.height_mm
        self._sections: dict[float, NominalSection] = {}

    def section(self, z_mm: float) -> NominalSection:
        if z_mm not in self._sections:
            self._sections[z_mm] = section_of(*self.blade.section(z_mm), z_mm)
        return self._sections[z_mm]


def alignment(
    information: Floats | None = None, T: Floats | None = None, pivot_z_mm: float = 52.5
) -> Alignment:
    """A scan in place about the middle of a blade, without any doubt of its pose unless told."""
    return in_place(T, pivot_z_mm, np.eye(6) * 1e12 if information is None else information)


def cloud_of(points_mm: Floats, sigma_mm: float) -> Cloud:
    count = len(points_mm)
    return Cloud(points_mm=points_mm, sigma_mm=np.full(count, sigma_mm), view=np.zeros(count, np.int64))


def scan_in_place(points_mm: Floats, sigma_mm: float, mask: Bools | None = None) -> Scan:
    """Points of the nominal frame as sections are cut from them; none is damaged unless told."""
    mask = np.zeros(len(points_mm), bool) if mask is None else mask
    return scan_of(cloud_of(points_mm, sigma_mm), mask, np.eye(4))
