"""How an edge is shaped: its longest flat and its sharpest radius. Drawings limit both beside the radius."""

from dataclasses import dataclass

import numpy as np

from geometry.sections.chart import outward_normals
from geometry.sections.curve import Edge, Estimate, node_arc
from geometry.types import Floats, Ints

_SPANS = 48  # widths that are tried for a flat


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Bows:
    """Chords of an edge about some of its nodes: length, and how far the profile bulges over them."""

    node: Ints  # (k,) in the middle
    length_mm: Floats  # (k, ...)
    bulge_mm: Floats  # (k, ...) positive outward


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Unrolled:
    """An edge's zone over its arc length."""

    zone: Ints
    arc_mm: Floats
    points_mm: Floats
    normals: Floats

    def at(self, arc_mm: Floats) -> Floats:
        """Points (..., 2) at arc lengths."""
        x, y = self.points_mm.T
        return np.stack([np.interp(arc_mm, self.arc_mm, x), np.interp(arc_mm, self.arc_mm, y)], axis=-1)

    def bows(self, node: Ints, half_mm: Floats) -> _Bows:
        """The chords from `half_mm` (k, ...) of arc before nodes of the zone to as much after them."""
        place = self.arc_mm[node].reshape(-1, *[1] * (half_mm.ndim - 1))
        before, after = self.at(place - half_mm), self.at(place + half_mm)
        chord = after - before
        length = np.linalg.norm(chord, axis=-1)
        middle = self.points_mm[node].reshape(len(node), *[1] * (half_mm.ndim - 1), 2)
        out = np.stack([chord[..., 1], -chord[..., 0]], axis=-1)
        bulge = ((middle - before) * out).sum(axis=-1) / length
        return _Bows(node=node, length_mm=length, bulge_mm=bulge)

    def growth(self, m: int, node: int, half_mm: float) -> tuple[Floats, Floats]:
        """Growth (m,) of one chord's length and bulge with each node's displacement along its normal."""
        here = self.arc_mm[node]
        ends = np.searchsorted(self.arc_mm, [here - half_mm, here + half_mm])
        before, after = np.clip(ends, 0, len(self.zone) - 1)
        chord = self.points_mm[after] - self.points_mm[before]
        along = chord / np.linalg.norm(chord)
        out = np.array([along[1], -along[0]])
        length, bulge = np.zeros(m), np.zeros(m)
        length[self.zone[before]] = -float(self.normals[before] @ along)
        length[self.zone[after]] = float(self.normals[after] @ along)
        bulge[self.zone[node]] += float(self.normals[node] @ out)
        for end in (before, after):
            bulge[self.zone[end]] -= 0.5 * float(self.normals[end] @ out)
        return length, bulge


def _unroll(curve_mm: Floats, end: Edge) -> _Unrolled:
    points = curve_mm[end.zone]
    return _Unrolled(
        zone=end.zone,
        arc_mm=node_arc(points),
        points_mm=points,
        normals=outward_normals(curve_mm)[end.zone],
    )


def _inside(end: Edge) -> Ints:
    """Where in the zone the nodes of the rounding are."""
    return np.flatnonzero(np.isin(end.zone, end.arc))


def min_radius(curve_mm: Floats, end: Edge, window_mm: float) -> Estimate:
    """The smallest radius of curvature on the rounding of an edge, over windows `window_mm` of arc wide.

    Each is the radius of the circle through the ends and the middle of its window; the narrower the
    window, the noisier the radius. The least of many scatters less than each: the gradient is that of the
    one window, and the sigma from it a bound, up to a third too large.
    """
    edge = _unroll(curve_mm, end)
    node = _inside(end)
    bows = edge.bows(node, np.full(len(node), 0.5 * window_mm))
    bent = bows.bulge_mm > 1e-9
    radius = np.full(len(node), np.inf)
    radius[bent] = 0.125 * bows.length_mm[bent] ** 2 / bows.bulge_mm[bent] + 0.5 * bows.bulge_mm[bent]
    least = int(np.argmin(radius))
    length, bulge = edge.growth(len(curve_mm), int(node[least]), 0.5 * window_mm)
    chord, rise = float(bows.length_mm[least]), float(bows.bulge_mm[least])
    gradient = 0.25 * chord / rise * length + (0.5 - 0.125 * (chord / rise) ** 2) * bulge
    return Estimate(value=float(radius[least]), gradient=gradient)


def flat(curve_mm: Floats, end: Edge, flat_mm: float) -> Estimate:
    """The longest chord on the rounding of an edge over which the profile bulges no more than `flat_mm`.

    The chord's middle and both its ends lie on the rounding. A circle of radius R has flats of about
    sqrt(8 R flat_mm); a blunt edge has one as wide as its rounding. No Gaussian describes the longest of
    many chords, each with noise as large as its bulge: the gradient is that of the one found, and the sigma
    from it a bound, up to three times too large.
    """
    edge = _unroll(curve_mm, end)
    node = _inside(end)
    place = edge.arc_mm[node]
    room = np.minimum(place - place[0], place[-1] - place)
    node, room = node[1:-1], room[1:-1]
    half = room[:, None] * np.linspace(0.0, 1.0, _SPANS + 1)[1:]
    bows = edge.bows(node, half)
    widest = _crossing(half, bows.bulge_mm, flat_mm)
    found = edge.bows(node, widest)
    best = int(np.argmax(found.length_mm))
    length, bulge = edge.growth(len(curve_mm), int(node[best]), float(widest[best]))
    rise, chord = float(found.bulge_mm[best]), float(found.length_mm[best])
    if rise > 0.5 * flat_mm:
        length = length - 0.5 * chord / rise * bulge  # bulge grows with the square of the length
    return Estimate(value=chord, gradient=length)


def _crossing(half_mm: Floats, bulge_mm: Floats, flat_mm: float) -> Floats:
    """The half width (k,) at which each bulge (k, w) first reaches `flat_mm`; the largest if never."""
    beyond = bulge_mm > flat_mm
    last = np.where(beyond.any(axis=1), beyond.argmax(axis=1), bulge_mm.shape[1] - 1)
    row = np.arange(len(last))
    before = np.maximum(last - 1, 0)
    first = last == 0
    low, below = (np.where(first, 0.0, each[row, before]) for each in (half_mm, bulge_mm))
    rise = bulge_mm[row, last] - below
    part = np.divide(flat_mm - below, rise, out=np.ones(len(row)), where=beyond.any(axis=1))
    widest: Floats = low + (half_mm[row, last] - low) * part
    return widest
