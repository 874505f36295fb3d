"""A blade in closed form for the tests of twin and damage: nominal mesh, deformed truth, scan with damage.

The section is a cosine-spaced shape-function airfoil over a parabolic camber line, twisted and slightly
tapered along z. `theta` runs round the section: 0 leading edge, (0, pi) suction side, pi trailing edge.
Nothing here uses the product.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import comb, pi, radians

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

CHORD_MM, SPAN_MM, TWIST_RAD, TAPER, CAMBER = 45.0, 105.0, radians(25.0), 0.12, 0.26
LE_RADIUS_MM, TE_RADIUS_MM = 0.55, 0.36
_SHAPE = np.array(
    [np.sqrt(2.0 * LE_RADIUS_MM / CHORD_MM), 0.09, 0.11, 0.075, np.sqrt(2.0 * TE_RADIUS_MM / CHORD_MM)]
)


def _shape(x: Array) -> Array:
    n = len(_SHAPE) - 1
    return np.asarray(sum(_SHAPE[k] * comb(n, k) * x**k * (1.0 - x) ** (n - k) for k in range(n + 1)))


def _untwisted(theta: Array) -> tuple[Array, Array]:
    x = 0.5 * (1.0 - np.cos(theta))
    half = 0.5 * np.sin(theta) * _shape(x)
    slope = CAMBER * (1.0 - 2.0 * x)
    cosine = 1.0 / np.sqrt(1.0 + slope**2)
    return CHORD_MM * (x - 0.45 - half * slope * cosine), CHORD_MM * (
        CAMBER * x * (1.0 - x) + half * cosine - 0.04
    )


def nominal(theta: Array, z: Array) -> Array:
    """Nominal surface points (..., 3)."""
    x, y = _untwisted(theta)
    scale = 1.0 - TAPER * z / SPAN_MM
    turn = TWIST_RAD * (z / SPAN_MM - 0.5)
    c, s = np.cos(turn), np.sin(turn)
    return np.stack([scale * (c * x - s * y), scale * (s * x + c * y), z + 0.0 * x], -1)


def _partials(surface: Callable[[Array, Array], Array], theta: Array, z: Array) -> tuple[Array, Array]:
    h = 1e-5
    return (
        (surface(theta + h, z) - surface(theta - h, z)) / (2 * h),
        (surface(theta, z + h) - surface(theta, z - h)) / (2 * h),
    )


def section_normal(theta: Array, z: Array) -> Array:
    """Outward normal (..., 3) of the nominal section in its own plane."""
    along = _partials(nominal, theta, z)[0]
    normal = np.stack([-along[..., 1], along[..., 0], 0.0 * along[..., 0]], -1)
    return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))


def _hump(z: Array, centre: float, half_width: float) -> Array:
    inside = np.abs(z - centre) < half_width
    return np.where(inside, np.cos(0.5 * pi * (z - centre) / half_width) ** 2, 0.0)


def _suction(theta: Array, sharp: float) -> Array:
    return np.asarray(0.5 * (1.0 + np.tanh(sharp * np.sin(theta))))


def ripple(theta: Array, z: Array) -> Array:
    """Manufacturing form error: a few micrometres, seven waves round the section."""
    amplitude = 0.0028 + 0.0018 * np.sin(0.31 * z + 0.4) * np.cos(0.17 * z)
    return np.asarray(amplitude * np.sin(7.0 * theta + 1.3 * np.sin(0.11 * z) + 0.02 * z))


def _belly(theta: Array) -> Array:
    return np.sin(pi * (0.08 + 0.86 * 0.5 * (1.0 - np.cos(theta))))


def _service(theta: Array, z: Array) -> Array:
    up, low = _suction(theta, 12.0), 1.0 - _suction(theta, 12.0)
    suction = 0.085 * _hump(z, 96.0, 40.0) - 0.035 * _hump(z, 30.0, 25.0)
    pressure = 0.080 * _hump(z, 94.0, 38.0) + 0.035 * _hump(z, 36.0, 24.0)
    return np.asarray(ripple(theta, z) + (up * suction - low * pressure) * _belly(theta))


def _thick(theta: Array, z: Array) -> Array:
    up, low = _suction(theta, 3.0), 1.0 - _suction(theta, 3.0)
    bulge = up * 0.085 * _hump(z, 96.0, 40.0) + low * 0.06 * _hump(z, 94.0, 40.0)
    return np.asarray(ripple(theta, z) + bulge * np.sin(0.5 * pi * (1.0 - np.cos(theta))))


def _thin(theta: Array, z: Array) -> Array:
    return np.asarray(ripple(theta, z) - 0.05 * _hump(z, 60.0, 70.0) * _belly(theta))


def _still(points: Array) -> Array:
    return points


def _bend(points: Array) -> Array:
    s = points[..., 2] / SPAN_MM
    turn = radians(0.3) * s
    x, y = points[..., 0], points[..., 1]
    c, si = np.cos(turn), np.sin(turn)
    return np.stack([c * x - si * y, si * x + c * y + 0.3 * s**2, points[..., 2]], -1)


def _droop(points: Array) -> Array:
    """The trailing edge hangs over the upper half of the span."""
    s = np.clip((points[..., 0] - 5.0) / 20.0, 0.0, None) ** 2 * (points[..., 2] / SPAN_MM) ** 2
    return np.stack([points[..., 0], points[..., 1] - 0.15 * s, points[..., 2]], -1)


@dataclass(frozen=True)
class Shape:
    """One deformed blade: an offset along the section normal, then a warp of space that keeps z."""

    offset: Callable[[Array, Array], Array]
    warp: Callable[[Array], Array] = _still

    def surface(self, theta: Array, z: Array) -> Array:
        return self.warp(nominal(theta, z) + self.offset(theta, z)[..., None] * section_normal(theta, z))


SHAPES = {
    "as made": Shape(lambda theta, z: 0.0 * theta + 0.0 * z),
    "ripple": Shape(ripple),
    "service": Shape(_service),
    "thick": Shape(_thick),
    "thin": Shape(_thin),
    "bend": Shape(_service, _bend),
    "droop": Shape(ripple, _droop),
}


class Truth:
    """Exact signed distance to the side surface of a shape (positive outside), by Newton on (theta, z)."""

    def __init__(self, shape: Shape) -> None:
        self.shape = shape
        theta, z = grid(0.6, -3.0, SPAN_MM + 3.0)
        self.theta, self.z = theta.ravel(), z.ravel()
        self.tree = cKDTree(shape.surface(self.theta, self.z))

    def parameters(self, points: Array) -> tuple[Array, Array]:
        _, near = self.tree.query(points)
        theta, z = self.theta[near].copy(), self.z[near].copy()
        for _ in range(8):
            a, b = _partials(self.shape.surface, theta, z)
            r = points - self.shape.surface(theta, z)
            aa, ab, bb = (a * a).sum(-1), (a * b).sum(-1), (b * b).sum(-1)
            ra, rb = (r * a).sum(-1), (r * b).sum(-1)
            det = aa * bb - ab * ab
            theta = theta + np.clip((ra * bb - rb * ab) / det, -0.02, 0.02)
            z = z + np.clip((rb * aa - ra * ab) / det, -0.5, 0.5)
        return theta, z

    def normal(self, theta: Array, z: Array) -> Array:
        a, b = _partials(self.shape.surface, theta, z)
        normal = np.cross(b, a)
        return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))

    def distance(self, points: Array) -> Array:
        theta, z = self.parameters(points)
        return np.asarray(((points - self.shape.surface(theta, z)) * self.normal(theta, z)).sum(-1))

    def inside(self, points: Array) -> NDArray[np.bool_]:
        return (self.distance(points) < 0.0) & (points[:, 2] < SPAN_MM) & (points[:, 2] > 0.0)


def grid(
    pitch_mm: float, z_low: float = 0.0, z_high: float = SPAN_MM, turn: float = 0.25
) -> tuple[Array, Array]:
    """theta, z (rows, columns) of a grid whose cells are `pitch_mm` long and turn at most `turn` rad."""
    dense = np.linspace(0.0, 2.0 * pi, 40001)
    x, y = _untwisted(dense)
    step = np.hypot(np.diff(x), np.diff(y))
    heading = np.unwrap(np.arctan2(np.diff(y), np.diff(x)))
    bend = np.abs(np.diff(heading, append=heading[:1] + 2.0 * pi * np.sign(heading[-1] - heading[0])))
    measure = np.concatenate([[0.0], np.cumsum(step / pitch_mm + bend / turn)])
    columns = int(np.ceil(measure[-1]))
    theta = np.interp(np.arange(columns) * measure[-1] / columns, measure, dense)
    z = np.linspace(z_low, z_high, int(np.ceil((z_high - z_low) / pitch_mm)) + 1)
    return tuple(np.meshgrid(theta, z))  # type: ignore[return-value]


def solid(
    pitch_mm: float, shape: Shape = SHAPES["as made"], turn: float = 0.25
) -> tuple[Array, NDArray[np.int64]]:
    """Closed mesh: vertices (n, 3) and outward faces (m, 3), plane ends at z = 0 and z = SPAN_MM."""
    theta, z = grid(pitch_mm, turn=turn)
    rows, columns = theta.shape
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    a, b = i * columns + j, i * columns + (j + 1) % columns
    side = np.concatenate(
        [
            np.stack([a, b + columns, b], -1).reshape(-1, 3),
            np.stack([a, a + columns, b + columns], -1).reshape(-1, 3),
        ]
    )
    vertices = shape.surface(theta, z).reshape(-1, 3)
    caps = []
    for first, up in ((0, False), ((rows - 1) * columns, True)):
        ring = vertices[first : first + columns, :2]
        cap = mapbox_earcut.triangulate_float64(ring, np.array([columns])).reshape(-1, 3).astype(np.int64)
        u, v = ring[cap[:, 1]] - ring[cap[:, 0]], ring[cap[:, 2]] - ring[cap[:, 0]]
        upward = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] > 0.0
        cap[upward != up] = cap[upward != up][:, ::-1]
        caps.append(cap + first)
    return vertices, np.concatenate([side, *caps])


@dataclass(frozen=True)
class Cut:
    """Removed metal: `gone` says which points (n, 3) lie in it, `skin` samples its surface at points per
    mm2."""

    gone: Callable[[Array], NDArray[np.bool_]]
    skin: Callable[[np.random.Generator, float], Array]


def _height_field(
    origin: Array, right: Array, up: Array, wave: Callable[[Array, Array], Array], half: Array
) -> Cut:
    """Everything above origin + u right + v (up x right) + wave(u, v) up is gone, for |u|, |v| < half."""
    across = np.cross(up, right)

    def gone(points: Array) -> NDArray[np.bool_]:
        local = (points - origin) @ np.stack([right, across, up], 1)
        within = (np.abs(local[:, 0]) < half[0]) & (np.abs(local[:, 1]) < half[1])
        return within & (local[:, 2] > wave(local[:, 0], local[:, 1]))

    def skin(rng: np.random.Generator, density: float) -> Array:
        count = int(density * 4.0 * half[0] * half[1])
        u, v = rng.uniform(-half[0], half[0], count), rng.uniform(-half[1], half[1], count)
        return origin + u[:, None] * right + v[:, None] * across + wave(u, v)[:, None] * up

    return Cut(gone, skin)


def _rough(u: Array, v: Array) -> Array:
    return np.asarray(
        0.3 * np.sin(0.9 * u + 0.6 * v) + 0.2 * np.sin(1.7 * v + 0.4 * u) + 0.6 * np.sin(0.22 * u)
    )


def tip_corner() -> Cut:
    """The trailing-edge corner of the tip is broken off along a tilted rough surface."""
    turn = TWIST_RAD * (95.0 / SPAN_MM - 0.5)
    chordwise = np.array([np.cos(turn), np.sin(turn), 0.0])
    right = chordwise * np.cos(1.05) - np.array([0.0, 0.0, 1.0]) * np.sin(1.05)
    up = chordwise * np.sin(1.05) + np.array([0.0, 0.0, 1.0]) * np.cos(1.05)
    return _height_field(12.0 * chordwise + [0.0, 2.0, 100.0], right, up, _rough, np.array([25.0, 14.0]))


def tip_loss(depth_mm: float, roughness: float = 1.0) -> Cut:
    """The whole tip is gone, `depth_mm` deep on average."""
    origin = np.array([0.0, 0.0, SPAN_MM - depth_mm])
    flat = np.array([1.0, 0.0, 0.0])
    return _height_field(
        origin, flat, np.array([0.0, 0.0, 1.0]), lambda u, v: roughness * _rough(u, v), np.array([30.0, 30.0])
    )


def _ball(centre: Array, radius: float) -> Cut:
    def skin(rng: np.random.Generator, density: float) -> Array:
        direction = rng.normal(size=(int(density * 4.0 * pi * radius**2), 3))
        return np.asarray(centre + radius * direction / np.linalg.norm(direction, axis=1, keepdims=True))

    return Cut(lambda points: np.linalg.norm(points - centre, axis=1) < radius, skin)


def pit(truth: Truth, theta: float, z: float, depth_mm: float, radius_mm: float) -> Cut:
    """A spherical hollow, `depth_mm` deep along the normal of the true surface."""
    t, h = np.array([theta]), np.array([z])
    surface, normal = truth.shape.surface(t, h)[0], truth.normal(t, h)[0]
    return _ball(surface + (radius_mm - depth_mm) * normal, radius_mm)


def nick(truth: Truth, theta: float, z: float, depth_mm: float, radius_mm: float) -> Cut:
    """A round notch through an edge (theta 0 or pi), `depth_mm` deep in the section plane from the edge."""
    t, h = np.array([theta]), np.array([z])
    edge, normal = truth.shape.surface(t, h)[0], truth.normal(t, h)[0]
    outward = normal * [1.0, 1.0, 0.0]
    outward /= np.linalg.norm(outward)
    axis = np.cross([0.0, 0.0, 1.0], outward)
    centre = edge + (radius_mm - depth_mm) * outward

    def gone(points: Array) -> NDArray[np.bool_]:
        offset = points - centre
        return np.hypot(offset @ outward, offset[:, 2]) < radius_mm

    def skin(rng: np.random.Generator, density: float) -> Array:
        count = int(density * 2.0 * pi * radius_mm * 16.0)
        angle, along = rng.uniform(0.0, 2.0 * pi, count), rng.uniform(-8.0, 8.0, count)
        around = np.cos(angle)[:, None] * outward + np.sin(angle)[:, None] * [0.0, 0.0, 1.0]
        return np.asarray(centre + radius_mm * around + along[:, None] * axis)

    return Cut(gone, skin)


def dented(shape: Shape, theta: float, z: float, depth_mm: float, width_mm: float) -> Shape:
    """`shape` with a smooth round hollow (negative depth: a lump) of full width `width_mm`."""
    centre = shape.surface(np.array([theta]), np.array([z]))[0]

    def offset(t: Array, h: Array) -> Array:
        r = np.linalg.norm(shape.surface(t, h) - centre, axis=-1)
        return np.asarray(
            shape.offset(t, h) - depth_mm * np.cos(0.5 * pi * np.clip(2.0 * r / width_mm, 0.0, 1.0)) ** 2
        )

    return Shape(offset, shape.warp)


def hollowed(shape: Shape, centres: Array, depth_mm: float, width_mm: float) -> Shape:
    """`shape` with smooth round hollows about points (n, 3) of its surface, apart from each other."""

    def offset(t: Array, h: Array) -> Array:
        points = shape.surface(t, h)
        return np.asarray(shape.offset(t, h) - hollow_depth(points, centres, depth_mm, width_mm))

    return Shape(offset, shape.warp)


def hollow_depth(points: Array, centres: Array, depth_mm: float, width_mm: float) -> Array:
    """Depth (...) at points (..., 3) of hollows about centres (n, 3), which do not overlap."""
    total = np.zeros(points.shape[:-1])
    for centre in centres:
        r = np.linalg.norm(points - centre, axis=-1)
        total += depth_mm * np.cos(0.5 * pi * np.clip(2.0 * r / width_mm, 0.0, 1.0)) ** 2
    return total


@dataclass(frozen=True)
class Scan:
    """Points of a damaged blade; `label` 0 on sound metal, i + 1 on the broken surface of cut i."""

    points: Array
    label: NDArray[np.int64]


def scan(
    truth: Truth,
    cuts: tuple[Cut, ...] = (),
    *,
    pitch_mm: float = 0.3,
    noise_mm: float = 0.0,
    scanned: Shape | None = None,
    z_low: float = 0.5,
    seed: int = 1,
) -> Scan:
    """Random scan of the blade `scanned` (default: the undamaged shape of `truth`) less `cuts`.

    One point per pitch^2; `noise_mm` is the standard deviation along the surface normal (isotropic noise).
    """
    rng = np.random.default_rng(seed)
    density = 1.0 / pitch_mm**2
    shape = scanned or truth.shape
    parts = [(_side(shape, rng, density, z_low), 0), (_tip_face(truth, rng, density), 0)]
    parts = [(p[~_gone(p, cuts)], label) for p, label in parts]
    for i, cut in enumerate(cuts):
        broken = cut.skin(rng, density)
        broken = broken[truth.inside(broken) & (broken[:, 2] > z_low)]
        parts.append((broken[~_gone(broken, cuts[:i] + cuts[i + 1 :])], i + 1))
    points = np.concatenate([p for p, _ in parts])
    label = np.concatenate([np.full(len(p), label) for p, label in parts])
    order = rng.permutation(len(points))
    return Scan(points[order] + rng.normal(0.0, noise_mm, points.shape), label[order])


def _gone(points: Array, cuts: tuple[Cut, ...]) -> NDArray[np.bool_]:
    removed = np.zeros(len(points), np.bool_)
    for cut in cuts:
        removed |= cut.gone(points)
    return removed


def _side(shape: Shape, rng: np.random.Generator, density: float, z_low: float) -> Array:
    dense = np.linspace(0.0, 2.0 * pi, 40001)
    x, y = _untwisted(dense)
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    count = int(density * arc[-1] * (SPAN_MM - z_low))
    theta, z = np.interp(rng.uniform(0.0, arc[-1], count), arc, dense), rng.uniform(z_low, SPAN_MM, count)
    kept = rng.uniform(size=count) < 1.0 - TAPER * z / SPAN_MM
    return shape.surface(theta[kept], z[kept])


def _tip_face(truth: Truth, rng: np.random.Generator, density: float) -> Array:
    theta = np.linspace(0.0, 2.0 * pi, 2000)
    rim = truth.shape.surface(theta, np.full(2000, SPAN_MM))
    low, high = rim.min(0), rim.max(0)
    points = rng.uniform(low, high, (int(density * (high[0] - low[0]) * (high[1] - low[1])), 3))
    points[:, 2] = SPAN_MM
    return np.asarray(points[truth.distance(points) < 0.0])
