"""The blade of thesis section 5.5 in closed form: twisted airfoil, wear in service, closed mesh.

Frame: origin at the centroid of the bottom section, +Z the stacking axis, z from 0 to the span. The
parameter theta runs round a section counter-clockwise seen from +Z: 0 is the leading edge, (0, pi) the
pressure side, pi the trailing edge, (pi, 2 pi) the suction side.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from math import comb, isfinite, pi

import numpy as np
from scipy.interpolate import CubicSpline

from simulators.sections import centroid_mm
from simulators.solids import Floats, Ints, Solid

Surface = Callable[[Floats, Floats], Floats]  # (theta, z_mm) of one shape -> points (..., 3)

WAVE_COUNT = 7
ROUNDING_ROWS = 12


@dataclass(frozen=True, kw_only=True)
class BladeShape:
    """A class/shape-transformation airfoil, twisted and tapered along the span.

    The end coefficients of the shape polynomial give the edge radii, sqrt(2 r / chord) (Kulfan 2008).
    A constant section with linear twist would be a screw and leave its pose free along the axis: hence
    the tapers, relative losses from bottom to tip, and a twist that grows with the height.
    """

    chord_mm: float = 45.0
    span_mm: float = 105.0
    twist_deg: float = 25.0
    twist_growth: float = 0.5  # the twist is this much slower than its mean at the bottom, faster at the tip
    le_radius_mm: float = 0.7
    te_radius_mm: float = 0.4
    thickness: tuple[float, float, float] = (0.115, 0.140, 0.085)  # inner coefficients, of the chord
    camber: float = 0.26  # of a parabola: the largest camber is a quarter of it, in chords
    chord_taper: float = 0.15
    thickness_taper: float = 0.35
    tip_rounding_mm: float = 0.0

    def __post_init__(self) -> None:
        sizes = (self.chord_mm, self.span_mm, self.le_radius_mm, self.te_radius_mm)
        if not all(isfinite(size) and size > 0.0 for size in sizes):
            raise ValueError(f"blade: sizes {sizes} are not positive")
        if not 0.0 <= self.tip_rounding_mm < self.te_radius_mm:
            raise ValueError(f"blade: a tip rounding of {self.tip_rounding_mm} mm closes the trailing edge")

    def surface(self, theta: Floats, z_mm: Floats) -> Floats:
        """Points (..., 3) of the nominal surface."""
        flat = self._untwisted(theta, z_mm) - self._stacking(z_mm)
        return self._twisted(flat, z_mm)

    def normals(self, theta: Floats, z_mm: Floats) -> Floats:
        """Outward unit normals (..., 2) of the section curve, in its plane."""
        step = 1e-5
        chordwise = self._untwisted(theta + step, z_mm) - self._untwisted(theta - step, z_mm)
        chordwise /= np.linalg.norm(chordwise, axis=-1)[..., None]
        normal = np.stack([chordwise[..., 1], -chordwise[..., 0]], axis=-1)
        return self._twisted(normal, z_mm)[..., :2]

    def _untwisted(self, theta: Floats, z_mm: Floats) -> Floats:
        """Points (..., 2) of the section with the chord along +X from 0 to its length."""
        theta, z_mm = np.broadcast_arrays(theta, z_mm)
        chord = self.chord_mm * (1.0 - self.chord_taper * z_mm / self.span_mm)
        x = 0.5 * (1.0 - np.cos(theta))
        half = -0.5 * np.sin(theta) * self._shape(x, z_mm, chord)
        slope = self.camber * (1.0 - 2.0 * x)
        lean = 1.0 / np.sqrt(1.0 + slope**2)
        across = np.stack([x - half * slope * lean, self.camber * x * (1.0 - x) + half * lean], axis=-1)
        points: Floats = chord[..., None] * across
        return points

    def _shape(self, x: Floats, z_mm: Floats, chord_mm: Floats) -> Floats:
        thin = 1.0 - self.thickness_taper * z_mm / self.span_mm
        inner = [coefficient * thin for coefficient in self.thickness]
        steep = np.hypot(1.0, self.camber)  # the camber line is longer than the chord by this at its ends
        ends = [np.sqrt(2.0 * radius * steep / chord_mm) for radius in (self.le_radius_mm, self.te_radius_mm)]
        coefficients = [ends[0], *inner, ends[1]]
        degree = len(coefficients) - 1
        terms = [a * comb(degree, k) * x**k * (1.0 - x) ** (degree - k) for k, a in enumerate(coefficients)]
        total: Floats = np.sum(terms, axis=0)
        return total

    @cached_property
    def _stack(self) -> CubicSpline:
        dense = np.linspace(0.0, 2.0 * pi, 8001)[:-1]
        z_mm = np.linspace(0.0, self.span_mm, 41)
        centroids = [centroid_mm(self._untwisted(dense, np.array(z))) for z in z_mm]
        return CubicSpline(z_mm, centroids)

    def _stacking(self, z_mm: Floats) -> Floats:
        stack: Floats = self._stack(z_mm)
        return stack

    def _twisted(self, flat: Floats, z_mm: Floats) -> Floats:
        height = z_mm / self.span_mm
        turn = np.radians(self.twist_deg) * (height - 0.5 + self.twist_growth * (height**2 - height))
        c, s = np.cos(turn), np.sin(turn)
        x, y = flat[..., 0], flat[..., 1]
        return np.stack(np.broadcast_arrays(c * x - s * y, s * x + c * y, z_mm), axis=-1)


@dataclass(frozen=True, kw_only=True)
class Wear:
    """What service did to the form, as displacements that are known in closed form.

    Along the normal in the section plane: a wave of `WAVE_COUNT` periods with random amplitudes up to
    `wave_mm`, bumps on both sides up to `bump_mm` (thesis: 0.04 to 0.08), and `thicker_mm` all over.
    In space, growing with the square of the height: the tip bent by `bend_mm` across the chord and
    turned back by `untwist_deg`.
    """

    wave_mm: float = 0.005
    bump_mm: float = 0.08
    thicker_mm: float = 0.0
    bend_mm: float = 0.0
    untwist_deg: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        sizes = (self.wave_mm, self.bump_mm, self.thicker_mm, self.bend_mm, self.untwist_deg)
        if not all(isfinite(size) for size in sizes):
            raise ValueError(f"wear: {sizes} are not finite")

    @cached_property
    def _wave(self) -> tuple[CubicSpline, CubicSpline]:
        rng = np.random.default_rng([self.seed, 7])
        knots = np.linspace(0.0, 1.0, 16)
        amplitude = CubicSpline(knots, rng.uniform(0.0, 1.0, 16))
        phase = CubicSpline(knots, np.cumsum(rng.uniform(-0.4, 0.4, 16)))
        return amplitude, phase

    @cached_property
    def _bumps(self) -> tuple[float, float]:
        rng = np.random.default_rng([self.seed, 11])
        return float(rng.uniform(0.9, 1.1)), float(rng.uniform(0.9, 1.1))

    def offset_mm(self, theta: Floats, height: Floats) -> Floats:
        """The displacement outward along the section normal; `height` is z over the span."""
        amplitude, phase = self._wave
        at = np.clip(height, 0.0, 1.0)
        wave = self.wave_mm * amplitude(at) * np.sin(WAVE_COUNT * theta + phase(at))
        x = 0.5 * (1.0 - np.cos(theta))
        suction = 0.5 * (1.0 - np.tanh(12.0 * np.sin(theta)))
        on_suction = self._bumps[0] * (_hump(height, 0.924, 0.381) - 0.42 * _hump(height, 0.267, 0.238))
        on_pressure = -self._bumps[1] * (_hump(height, 0.905, 0.362) + 0.44 * _hump(height, 0.333, 0.229))
        chordwise = np.sin(pi * (0.10 + 0.85 * x))
        bumps = self.bump_mm * chordwise * (suction * on_suction + (1.0 - suction) * on_pressure)
        offset: Floats = wave + bumps + self.thicker_mm
        return offset

    def bent(self, points_mm: Floats, height: Floats) -> Floats:
        """Points (..., 3) after bending and untwisting; the height of a point is kept."""
        turn = -np.radians(self.untwist_deg) * height**2
        c, s = np.cos(turn), np.sin(turn)
        x, y, z = np.moveaxis(points_mm, -1, 0)
        return np.stack([c * x - s * y, s * x + c * y + self.bend_mm * height**2, z], axis=-1)


def _hump(height: Floats, centre: float, half_width: float) -> Floats:
    within = np.abs(height - centre) < half_width
    return np.where(within, np.cos(pi * (height - centre) / (2.0 * half_width)) ** 2, 0.0)


def worn_surface(shape: BladeShape, wear: Wear) -> Surface:
    """The surface of the blade after service, in the nominal frame, as a function of theta and z."""

    def surface(theta: Floats, z_mm: Floats) -> Floats:
        theta, z_mm = np.broadcast_arrays(theta, z_mm)
        points = shape.surface(theta, z_mm)
        offset = wear.offset_mm(theta, z_mm / shape.span_mm)
        points[..., :2] += offset[..., None] * shape.normals(theta, z_mm)
        return wear.bent(points, z_mm / shape.span_mm)

    return surface


def section_curve(surface: Surface, z_mm: float, T: Floats, count: int = 4000) -> Floats:
    """The curve (count, 2) in which the plane z = `z_mm` cuts the surface after the rigid motion `T`.

    For each theta the parameter height is solved for; the slope is near 1, so that plain substitution
    gains several digits a step. Sampled densely at the edges. Raises ValueError without convergence.
    """
    theta = section_thetas(count)
    height = np.full(count, z_mm)
    for _ in range(50):
        points = surface(theta, height) @ T[:3, :3].T + T[:3, 3]
        miss = z_mm - points[:, 2]
        if np.abs(miss).max() < 1e-11:
            return np.ascontiguousarray(points[:, :2])
        height = height + miss
    raise ValueError(f"the plane z = {z_mm} mm does not cut the surface once for each theta")


@cache
def section_thetas(count: int) -> Floats:
    """`count` (even) parameters round a section, symmetric, as dense at the edges as these are sharp.

    The step keeps the sagitta of a facet about even: density ~ sqrt(curvature) of the arc, floored.
    """
    shape = BladeShape()
    dense = np.linspace(0.0, pi, 20001)
    points = [shape.surface(sign * dense, np.array(0.5 * shape.span_mm))[:, :2] for sign in (1.0, -1.0)]
    density = np.max([_facet_density(side) for side in points], axis=0)
    total = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    half = np.interp(np.linspace(0.0, total[-1], count // 2 + 1), total, dense)
    thetas = np.concatenate([half, 2.0 * pi - half[-2:0:-1]])
    thetas.flags.writeable = False
    return thetas


def _facet_density(points: Floats) -> Floats:
    first = np.gradient(points, axis=0)
    second = np.gradient(first, axis=0)
    speed = np.linalg.norm(first, axis=1)
    curvature = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / speed**3
    density: Floats = (np.sqrt(np.clip(curvature, 0.0, 4.0)) + 0.12) * speed
    return density


def blade_solid(shape: BladeShape, surface: Surface, around: int = 480, along: int = 211) -> Solid:
    """The closed mesh of a surface between the plane root face z = 0 and the plane tip face.

    `around` points a section, `along` sections. At the defaults no facet leaves the surface by 1 um.
    """
    theta = section_thetas(around)
    flank = np.linspace(0.0, shape.span_mm - shape.tip_rounding_mm, along)
    rows = [surface(theta, np.full(around, z)) for z in flank]
    rows += _rounded_rows(shape, surface, theta)
    faces = [_wall_faces(len(rows), around)]
    faces += [_cap_faces(around)[:, ::-1], _cap_faces(around) + (len(rows) - 1) * around]
    return Solid(vertices_mm=np.concatenate(rows), faces=np.concatenate(faces))


def _rounded_rows(shape: BladeShape, surface: Surface, theta: Floats) -> list[Floats]:
    radius = shape.tip_rounding_mm
    if radius == 0.0:
        return []
    rows = []
    for angle in np.linspace(0.0, 0.5 * pi, ROUNDING_ROWS + 1)[1:]:
        z_mm = np.full(len(theta), shape.span_mm - radius * (1.0 - np.sin(angle)))
        row = surface(theta, z_mm)
        row[:, :2] -= radius * (1.0 - np.cos(angle)) * shape.normals(theta, z_mm)
        rows.append(row)
    return rows


def _wall_faces(rows: int, around: int) -> Ints:
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(around), indexing="ij")
    here, beside = i * around + j, i * around + (j + 1) % around
    above, across = here + around, beside + around
    lower = np.stack([here, beside, across], axis=-1)
    upper = np.stack([here, across, above], axis=-1)
    return np.concatenate([lower.reshape(-1, 3), upper.reshape(-1, 3)]).astype(np.int64)


def _cap_faces(around: int) -> Ints:
    """Faces of a plane end, looking along +Z: a ladder between theta and -theta."""
    pressure = np.arange(1, around // 2)
    suction = around - pressure
    nose = [(0, 1, around - 1)]
    tail = [(pressure[-1], around // 2, suction[-1])]
    rungs = [
        face
        for a, b, c, d in zip(pressure[:-1], pressure[1:], suction[1:], suction[:-1], strict=True)
        for face in ((a, b, c), (a, c, d))
    ]
    return np.array(nose + rungs + tail, dtype=np.int64)
