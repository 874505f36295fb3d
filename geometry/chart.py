"""The nominal airfoil near a section, unrolled: arc length and height address the surface.

A part is seen on the chart after its own rigid motion in the plane has been undone.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from geometry.errors import BadInput
from geometry.kernels.profile import project
from geometry.nominal import Nominal, NominalSection
from geometry.types import Floats, Ints

NODES = 2048  # of a profile; half on each side between the edges
_TUKEY = 4.685  # standard deviations; 95 % efficient on Gaussian residuals


@dataclass(frozen=True, slots=True, kw_only=True)
class SectionSettings:
    """How sections are reconstructed."""

    max_gap_mm: float = 1.5  # an arc without points wider than this was not measured
    band_mm: float = 6.0  # neighbouring z on each side that takes part
    layer_mm: float = 1.5  # pitch of the nominal sections inside the band
    knot_mm: float = 0.7  # spline knots along the sides ...
    edge_refinement: float = 4.0  # ... and this many times closer at the edges
    edge_mm: float = 2.0  # half width of the refined arc
    z_knot_mm: float = 4.0
    capture_mm: float = 1.0  # farther from the moved nominal is no point of the profile
    outlier: float = 5.0  # standard deviations
    damage_reach_mm: float = 25.0  # along z: how far from a gap its damaged border is looked for
    min_points: int = 60

    def __post_init__(self) -> None:
        lengths = (self.max_gap_mm, self.band_mm, self.layer_mm, self.knot_mm, self.edge_mm, self.z_knot_mm)
        if not all(np.isfinite(x) and x > 0.0 for x in (*lengths, self.capture_mm, self.outlier)):
            raise BadInput("section settings: a length is not a positive number")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chart:
    """Nominal sections of a band, as curves of corresponding nodes: node 0 trailing, NODES / 2 leading edge.

    Node coordinate in [0, NODES) and z address the surface; nodes crowd at the edges.
    """

    z_mm: Floats  # (k,), ascending
    nodes_mm: Floats  # (k, NODES, 2)
    here: int  # the layer of the section itself
    arc_mm: Floats  # (NODES + 1,) along the section itself, closed
    seeds: Ints
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
        return project(points, self.z_mm, self.nodes_mm, self.seeds, self.corner_mm, self.cell_mm)

    def growth(self) -> Floats:
        """How the nodes move with z at the section itself, (NODES, 2) mm per mm."""
        low, high = max(self.here - 1, 0), min(self.here + 1, len(self.z_mm) - 1)
        growth: Floats = (self.nodes_mm[high] - self.nodes_mm[low]) / (self.z_mm[high] - self.z_mm[low])
        return growth

    def arc_at(self, node: Floats) -> Floats:
        """Arc length on the section of node coordinates."""
        return np.interp(node, np.arange(NODES + 1), self.arc_mm)


def unroll(nominal: Nominal, z_mm: float, reach_mm: float, settings: SectionSettings) -> Chart:
    """The chart of the nominal within `reach_mm` of the plane `z_mm`."""
    low = max(z_mm - reach_mm, nominal.z_min_mm)
    high = min(z_mm + reach_mm, nominal.z_max_mm)
    if not low <= z_mm <= high or high - low < 1e-6:
        raise BadInput(f"section z = {z_mm} mm is outside the airfoil")
    below = np.linspace(low, z_mm, 1 + int(np.ceil((z_mm - low) / settings.layer_mm)))
    above = np.linspace(z_mm, high, 1 + int(np.ceil((high - z_mm) / settings.layer_mm)))
    heights = np.unique(np.concatenate([below, above]))
    here = int(np.argmin(np.abs(heights - z_mm)))
    sections = [nominal.section(float(z)) for z in heights]
    fractions = [_fractions(length, settings) for length in _side_lengths(sections[here])]
    nodes = np.stack([_resample(section, fractions) for section in sections])
    seeds, corner, cell = _seeds(nodes[here])
    arc = np.concatenate([[0.0], np.cumsum(_lengths(nodes[here]))])
    return Chart(
        z_mm=heights, nodes_mm=nodes, here=here, arc_mm=arc, seeds=seeds, corner_mm=corner, cell_mm=cell
    )


def outward_normals(curve_mm: Floats) -> Floats:
    """Unit outward normals (m, 2) of a closed counter-clockwise curve, from each node's neighbours."""
    along = np.roll(curve_mm, -1, axis=0) - np.roll(curve_mm, 1, axis=0)
    return np.column_stack([along[:, 1], -along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]


def _lengths(curve_mm: Floats) -> Floats:
    """Length of the segment from each node to the next one, closed."""
    return np.linalg.norm(np.roll(curve_mm, -1, axis=0) - curve_mm, axis=1)


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


def _seeds(curve_mm: Floats) -> tuple[Ints, Floats, float]:
    """For each cell of a grid over the section the nearest node, and the one on the other side if near too.

    Near: within what a cell and the twist of the band can hide.
    """
    cell, margin, doubt = 0.5, 2.0, 3.0
    corner = curve_mm.min(axis=0) - margin
    count = np.ceil((curve_mm.max(axis=0) + margin - corner) / cell).astype(np.int64)
    at = corner + cell * (np.indices(tuple(count)).reshape(2, -1).T + 0.5)
    half = NODES // 2
    away, near = np.transpose([cKDTree(curve_mm[i : i + half]).query(at) for i in (0, half)], (1, 2, 0))
    nodes = near.astype(np.int64) + np.array([0, half])
    first = np.argmin(away, axis=1)
    here = np.arange(len(at))
    other = np.where(away[here, 1 - first] - away[here, first] < doubt, nodes[here, 1 - first], -1)
    return np.column_stack([nodes[here, first], other]).reshape(*count, 2), corner, cell


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion:
    """A rigid motion in the plane about `pivot_mm`, linear in height: (x, y in mm, turn in rad) + slope."""

    pivot_mm: Floats  # (2,)
    z_mm: float
    rest: Floats  # (3,)
    per_mm: Floats  # (3,)

    def at(self, z_mm: Floats) -> Floats:
        return self.rest + np.multiply.outer(z_mm - self.z_mm, self.per_mm)

    def undo(self, points_mm: Floats) -> Floats:
        """Points (n, 3) taken back onto the nominal."""
        move = self.at(points_mm[:, 2])
        x, y = (points_mm[:, :2] - self.pivot_mm - move[:, :2]).T
        c, s = np.cos(move[:, 2]), np.sin(move[:, 2])
        return np.column_stack(
            [c * x + s * y + self.pivot_mm[0], c * y - s * x + self.pivot_mm[1], points_mm[:, 2]]
        )

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
    some = points_mm[:: max(1, len(points_mm) // 4000)]
    for _ in range(6):
        motion = Motion(pivot_mm=pivot, z_mm=z_mm, rest=total[:3], per_mm=total[3:])
        back = motion.undo(some)
        foot = chart.project(back)
        residual = foot[:, 1]
        scale = 1.4826 * float(np.median(np.abs(residual))) + 1e-6
        weight = np.clip(1.0 - (residual / (_TUKEY * scale)) ** 2, 0.0, None) ** 2 / scale**2
        columns = rigid_columns(back, foot[:, 2:], pivot, back[:, 2] - z_mm)
        normal = columns.T @ (columns * weight[:, None]) + np.diag(prior)
        step = np.linalg.solve(normal, columns.T @ (weight * residual) - prior * total)
        total = total + step
        if np.abs(step[:2]).max() < 1e-4 and abs(step[2]) < 1e-5:
            break
    return Motion(pivot_mm=pivot, z_mm=z_mm, rest=total[:3], per_mm=total[3:])
