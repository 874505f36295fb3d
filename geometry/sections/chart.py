"""The nominal airfoil near a section, unrolled: arc length and height address the surface.

A part is seen on the chart after its own rigid motion in the plane (`motion`) has been undone.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from geometry.blade.nominal import Nominal, NominalSection
from geometry.errors import BadInput
from geometry.kernels.airfoil import closed_normals, closed_steps
from geometry.kernels.profile import lay, project
from geometry.types import Bools, Floats, Ints

NODES = 2048  # of a profile; half on each side between the edges
BROAD = 4  # nodes: at an edge about as far as the facets of a nominal are long


Freedom = Literal["x", "y", "rotation"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FitSettings:
    """How a section is best fitted to its nominal: what each side weighs, and what must not move."""

    le: float = 1.0
    suction: float = 1.0
    te: float = 1.0
    pressure: float = 1.0
    locked: frozenset[Freedom] = frozenset()

    def __post_init__(self) -> None:
        if not (np.isfinite(self.weights).all() and (self.weights >= 0.0).all() and self.weights.any()):
            raise BadInput("section fit: a weight is not a number >= 0, or all are 0")
        if not self.locked <= {"x", "y", "rotation"}:
            raise BadInput("section fit: only x, y and rotation can be locked")

    @property
    def weights(self) -> Floats:
        """By side, as `NominalSection.side` numbers them."""
        return np.array([self.le, self.suction, self.te, self.pressure])


@dataclass(frozen=True, slots=True, kw_only=True)
class SectionSettings:
    """How sections are reconstructed."""

    max_gap_mm: float = 1.5  # an arc without points wider than this was not measured ...
    gap_share: float = 0.008  # ... or wider than this share of the perimeter, if chance leaves none such
    band_mm: float = 6.0  # neighbouring z on each side that takes part, at least ...
    band_spacings: float = 60.0  # ... and of a sparser scan so many times the distance of its points, ...
    widest_band_mm: float = 12.0  # ... but no more than this
    most_z_spans: int = 5  # of the spline over a band
    layer_mm: float = 6.0  # of height that three nominal sections bridge, unless a parabola ...
    blend_mm: float = 0.0005  # ... is more than this off: then less,
    thinnest_layer_mm: float = 0.4  # down to this; ...
    blend_limit_mm: float = 0.005  # ... what is then still more than this off takes no part
    steepest: float = 1.0  # mm outward per mm of height: what lies flatter belongs to a fillet or a tip face
    knot_mm: float = 1.0  # spline knots along the sides ...
    edge_refinement: float = 6.0  # ... and this many times closer at the edges
    edge_mm: float = 0.7  # half width of the refined arc: the rounding of an edge, not the taper behind it
    z_knot_mm: float = 4.0
    capture_mm: float = 1.0  # farther from the moved nominal is no point of the profile
    outlier: float = 5.0  # standard deviations
    damage_reach_mm: float = 25.0  # along z: how far from a gap its damaged border is looked for
    min_points: int = 60
    tolerance_mm: float = 0.1  # of the profile: the share of the arc that is farther off is reported
    edge_distances_mm: tuple[float, ...] = (2.0, 4.0)  # from each edge: where its thickness is taken
    flat_mm: float = 0.005  # what bulges less than this over its chord is a flat of an edge
    wave_mm: tuple[float, float] = (2.5, 15.0)  # wavelengths that are waviness
    fit: FitSettings = FitSettings()

    def __post_init__(self) -> None:
        lengths = (self.max_gap_mm, self.band_mm, self.layer_mm, self.knot_mm, self.edge_mm, self.z_knot_mm)
        asked = (
            self.gap_share,
            self.band_spacings,
            self.widest_band_mm,
            self.tolerance_mm,
            *self.edge_distances_mm,
            self.flat_mm,
            *self.wave_mm,
        )
        if not all(np.isfinite(x) and x > 0.0 for x in (*lengths, *asked, self.capture_mm, self.outlier)):
            raise BadInput("section settings: a length is not a positive number")
        if not self.band_mm <= self.widest_band_mm:
            raise BadInput("section settings: the widest band is narrower than the narrowest")
        if not self.wave_mm[0] < self.wave_mm[1]:
            raise BadInput("section settings: the shortest wave is not shorter than the longest")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chart:
    """Nominal sections of a band, as curves of corresponding nodes: node 0 trailing, NODES / 2 leading edge.

    Node coordinate in [0, NODES) and z address the surface; nodes crowd at the edges. Sections come in
    threes, low, halfway, high, which a parabola in height bridges.
    """

    z_mm: Floats  # (2 k + 1,), ascending
    nodes_mm: Floats  # (2 k + 1, NODES, 2)
    curves: Floats  # (k, NODES, 8) these parabolas and how steep they are, as `project` takes them
    here: int  # the layer of the section itself
    arc_mm: Floats  # (NODES + 1,) along the section itself, closed
    side: Ints  # (NODES,) as in `NominalSection`: 0 leading edge, 1 suction, 2 trailing edge, 3 pressure
    seeds: Ints
    across_mm: Floats  # (NODES,) how far the nearest node of the other side is
    corner_mm: Floats
    cell_mm: float

    @property
    def curve_mm(self) -> Floats:
        return self.nodes_mm[self.here]

    @property
    def section_z_mm(self) -> float:
        return float(self.z_mm[self.here])

    @property
    def perimeter_mm(self) -> float:
        return float(self.arc_mm[-1])

    def project(self, points_mm: Floats) -> Floats:
        """Node coordinate, signed in-plane distance and outward normal of (n, 3) points: (n, 4)."""
        points = np.ascontiguousarray(points_mm)
        grid = self.seeds, self.across_mm, self.corner_mm, self.cell_mm
        return project(points, self.z_mm, self.curves, *grid)

    def growth(self) -> Floats:
        """How the nodes move with z at the section itself, (NODES, 2) mm per mm."""
        low, high = max(self.here - 1, 0), min(self.here + 1, len(self.z_mm) - 1)
        growth: Floats = (self.nodes_mm[high] - self.nodes_mm[low]) / (self.z_mm[high] - self.z_mm[low])
        return growth

    def pose_growth(self, curve_mm: Floats, pivot_mm: Floats) -> Floats:
        """(NODES, 6): growth of the outward displacement of a measured curve's nodes, in the section's plane,
        with a pose twist of the part about `pivot_mm`."""
        place_mm = np.column_stack([curve_mm, np.full(NODES, self.section_z_mm)]) - pivot_mm
        normals = outward_normals(curve_mm)
        push = np.column_stack([normals, -(normals * self.growth()).sum(axis=1)])
        return np.hstack([np.cross(place_mm, push), push])

    def lay(
        self,
        points_mm: Floats,
        sigma_mm: Floats,
        motion: tuple[Floats, float, Floats, Floats],
        limits: tuple[float, float],
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """What of the points (n, 3), their motion undone, is near and upright enough: see the kernel."""
        surface = self.z_mm, self.curves, self.seeds, self.across_mm, self.corner_mm, self.cell_mm
        return lay(np.ascontiguousarray(points_mm), sigma_mm, motion, surface, limits)

    def arc_at(self, node: Floats) -> Floats:
        """Arc length on the section of node coordinates."""
        return np.interp(node, np.arange(NODES + 1), self.arc_mm)


def unroll(nominal: Nominal, z_mm: float, reach_mm: float, settings: SectionSettings) -> Chart:
    """The chart of the nominal within `reach_mm` of the plane `z_mm`."""
    low = max(z_mm - reach_mm, nominal.z_min_mm)
    high = min(z_mm + reach_mm, nominal.z_max_mm)
    if not low <= z_mm <= high or high - low < 1e-6:
        raise BadInput(f"section z = {z_mm} mm is outside the airfoil")
    fractions = [_fractions(length, settings) for length in _side_lengths(nominal.section(z_mm))]

    @cache
    def nodes_at(height_mm: float) -> Floats:
        return _resample(nominal.section(height_mm), fractions)

    count = [int(np.ceil(part / settings.layer_mm)) for part in (z_mm - low, high - z_mm)]
    ends = np.concatenate([np.linspace(low, z_mm, count[0] + 1), np.linspace(z_mm, high, count[1] + 1)])
    threes = [
        three
        for bottom, top in pairwise(np.unique(ends).tolist())
        for three in _bridge(bottom, top, nodes_at, settings)
    ]
    heights = [float(low), *(height for three in threes for height in three.above_mm)]
    nodes = np.stack([nodes_at(height) for height in heights])
    trusted = np.stack([three.wrong_mm <= settings.blend_limit_mm for three in threes])
    here = heights.index(z_mm)
    return _chart(np.array(heights), nodes, trusted, here, _sides(nominal.section(z_mm), nodes[here]))


def with_nodes(chart: Chart, nodes_mm: Floats) -> Chart:
    """The chart of other curves (2 k + 1, NODES, 2) at the same heights, whose nodes correspond."""
    trusted = np.isfinite(chart.curves[:, :, 6])
    return _chart(chart.z_mm, nodes_mm, trusted, chart.here, chart.side)


def _chart(z_mm: Floats, nodes_mm: Floats, trusted: Bools, here: int, side: Ints) -> Chart:
    seeds, across, corner, cell = _seeds(nodes_mm, here)
    return Chart(
        z_mm=z_mm,
        nodes_mm=nodes_mm,
        curves=_curves(z_mm, nodes_mm, trusted),
        here=here,
        arc_mm=np.concatenate([[0.0], np.cumsum(_lengths(nodes_mm[here]))]),
        side=side,
        seeds=seeds,
        across_mm=across,
        corner_mm=corner,
        cell_mm=cell,
    )


def outward_normals(curve_mm: Floats) -> Floats:
    """Unit outward normals (m, 2) of a closed counter-clockwise curve, from each node's neighbours."""
    return np.asarray(closed_normals(np.ascontiguousarray(curve_mm)))


def broad_normals(curve_mm: Floats) -> Floats:
    """The same from nodes `BROAD` to either side: along a polygon of facets they turn smoothly.

    The normals of the polygon itself jump at each corner, and what is drawn inward along them folds there.
    """
    x, y = (np.roll(curve_mm, -BROAD, axis=0) - np.roll(curve_mm, BROAD, axis=0)).T
    return np.asarray(np.column_stack([y, -x]) / np.hypot(x, y)[:, None])


def outward_normal(curve_mm: Floats, node: int) -> Floats:
    """The same at one node, (2,)."""
    x, y = curve_mm[(node + 1) % len(curve_mm)] - curve_mm[node - 1]
    return np.array([y, -x]) / np.hypot(x, y)


def _curves(z_mm: Floats, nodes_mm: Floats, trusted: Bools) -> Floats:
    """What `project` takes: the parabola in height of every node over each three sections (place, slope and
    bend), and between the outer two how far it moves outward with height, where that is `trusted`."""
    low, middle, high = nodes_mm[:-1:2], nodes_mm[1::2], nodes_mm[2::2]
    normals = np.stack([outward_normals(curve) for curve in nodes_mm])
    growth = (np.gradient(nodes_mm, z_mm, axis=0) * normals).sum(axis=2)
    steep = np.stack([growth[:-1:2], growth[2::2] - growth[:-1:2]], axis=2)
    steep[~trusted] = np.nan
    slope, bend = 4.0 * middle - 3.0 * low - high, 2.0 * (low + high) - 4.0 * middle
    return np.ascontiguousarray(np.concatenate([low, slope, bend, steep], axis=2))


def curvature(curve_mm: Floats) -> Floats:
    """Curvature (m,) at the nodes of a closed counter-clockwise curve, 1 / mm, positive where it bulges.

    Over five nodes, so that the corners of a coarse nominal polygon do not stand out.
    """
    one, other = curve_mm - np.roll(curve_mm, 2, axis=0), np.roll(curve_mm, -2, axis=0) - curve_mm
    cross = one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]
    sizes = (np.linalg.norm(each, axis=1) for each in (one, other, one + other))
    return 2.0 * cross / np.prod(list(sizes), axis=0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Three:
    """An interval of height bridged by a parabola through three sections."""

    above_mm: tuple[float, float]  # halfway and high
    wrong_mm: Floats  # (NODES,) how far a section between them is off


def _bridge(
    low_mm: float, high_mm: float, nodes_at: Callable[[float], Floats], settings: SectionSettings
) -> list[_Three]:
    """The intervals from `low_mm` to `high_mm`, each confirmed by the section a quarter of the way up."""
    middle, quarter = 0.5 * (low_mm + high_mm), 0.75 * low_mm + 0.25 * high_mm
    found = nodes_at(quarter)
    blend = 0.375 * nodes_at(low_mm) + 0.75 * nodes_at(middle) - 0.125 * nodes_at(high_mm)
    wrong = np.abs(((found - blend) * outward_normals(found)).sum(axis=1))
    if wrong.max() <= settings.blend_mm or high_mm - low_mm < 2.0 * settings.thinnest_layer_mm:
        return [_Three(above_mm=(middle, high_mm), wrong_mm=wrong)]
    below = _bridge(low_mm, middle, nodes_at, settings)
    return [*below, *_bridge(middle, high_mm, nodes_at, settings)]


def _lengths(curve_mm: Floats) -> Floats:
    """Length of the segment from each node to the next one, closed."""
    return np.asarray(closed_steps(np.ascontiguousarray(curve_mm)))


def _side_lengths(section: NominalSection) -> tuple[float, float]:
    """Arc from trailing to leading edge, and back."""
    first = (section.arc_mm[section.le_index] - section.arc_mm[section.te_index]) % section.perimeter_mm
    return float(first), float(section.perimeter_mm - first)


def edge_width(length_mm: float, settings: SectionSettings) -> float:
    return min(settings.edge_mm, 0.08 * length_mm)


def _density(arc_mm: Floats, length_mm: float, settings: SectionSettings) -> Floats:
    """How much closer than on a flat side the nodes stand, along one side."""
    width = edge_width(length_mm, settings)
    bumps = np.exp(-((arc_mm / width) ** 2)) + np.exp(-(((length_mm - arc_mm) / width) ** 2))
    return 1.0 + (settings.edge_refinement - 1.0) * bumps


def _fractions(length_mm: float, settings: SectionSettings) -> Floats:
    """Fractions of a side's arc at which its NODES / 2 nodes stand, the last edge left out."""
    arc = np.linspace(0.0, length_mm, 4001)
    density = _density(arc, length_mm, settings)
    share = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))])
    return np.interp(np.arange(NODES // 2) / (NODES // 2), share / share[-1], arc / length_mm)


def _resample(section: NominalSection, fractions: list[Floats]) -> Floats:
    """The NODES corresponding nodes of one nominal section, (NODES, 2)."""
    curve = np.roll(section.curve_mm, -section.te_index, axis=0)
    arc = np.concatenate([[0.0], np.cumsum(_lengths(curve))])
    closed = np.vstack([curve, curve[:1]])
    first, second = _side_lengths(section)
    at = np.concatenate([first * fractions[0], first + second * fractions[1]])
    return np.column_stack([np.interp(at, arc, closed[:, 0]), np.interp(at, arc, closed[:, 1])])


def _sides(section: NominalSection, nodes_mm: Floats) -> Ints:
    """The nominal's own side of each node."""
    return section.side[cKDTree(section.curve_mm).query(nodes_mm)[1]]


def _seeds(nodes_mm: Floats, here: int) -> tuple[Ints, Floats, Floats, float]:
    """For each cell of a grid over the section the nearest node, and the one on the other side if near too;
    and how far the other side is from each node, (NODES,).

    Near: within what the size of a cell and the movement of the nodes over the band can hide.
    """
    curve = nodes_mm[here]
    cell, margin, moves = 0.5, 2.0, nodes_mm - curve
    doubt = 2.0 * (cell * np.sqrt(0.5) + float(np.abs((moves * outward_normals(curve)).sum(axis=2)).max()))
    corner = curve.min(axis=0) - margin
    count = np.ceil((curve.max(axis=0) + margin - corner) / cell).astype(np.int64)
    at = corner + cell * (np.indices(tuple(count)).reshape(2, -1).T + 0.5)
    half = NODES // 2
    sides = [cKDTree(curve[i : i + half]) for i in (0, half)]
    away, near = np.transpose([side.query(at) for side in sides], (1, 2, 0))
    across = np.concatenate([sides[1].query(curve[:half])[0], sides[0].query(curve[half:])[0]])
    nodes = near.astype(np.int64) + np.array([0, half])
    first = np.argmin(away, axis=1)
    rows = np.arange(len(at))
    other = np.where(away[rows, 1 - first] - away[rows, first] < doubt, nodes[rows, 1 - first], -1)
    return np.column_stack([nodes[rows, first], other]).reshape(*count, 2), across, corner, cell
