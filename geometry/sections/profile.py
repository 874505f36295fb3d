"""Cloud near a plane -> the reconstructed section profile, with its covariance and its gaps.

The profile is the nominal section, moved rigidly as the part was, plus a smooth deviation along its
normals (`geometry.sections.band`). What has no points is a gap, never bridged.
"""

from dataclasses import dataclass, replace

import numpy as np

from geometry.blade.nominal import Nominal
from geometry.errors import CannotMeasure
from geometry.kernels.profile_spline import SplineFit
from geometry.kernels.tensor_spline import cubic_weights
from geometry.sections.band import Knots, band_of, left_over, onto_chart, robust_fit
from geometry.sections.chart import (
    NODES,
    Chart,
    SectionSettings,
    broad_normals,
    curvature,
    unroll,
)
from geometry.sections.motion import Motion, find_motion, rigid_columns
from geometry.sections.worn_edges import with_worn_edges
from geometry.transforms import apply
from geometry.types import Bools, Cloud, Floats, Ints


@dataclass(frozen=True, slots=True, kw_only=True)
class Gap:
    """An arc of the section without points, from `start_mm` on; it may run over the trailing edge."""

    start_mm: float
    width_mm: float
    in_damage: bool  # damaged points border it: metal lost or bent there, and seen to be


@dataclass(frozen=True, slots=True, kw_only=True)
class ZoneArc:
    """How much of one side has points: the part outside gaps, and the widest stretch without a point."""

    covered_fraction: float
    largest_gap_mm: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Profile:
    """The reconstructed section: NODES nodes that correspond to those of the chart's curve."""

    chart: Chart  # of the nominal, its edges pushed to where the part has them
    curve_mm: Floats  # (NODES, 2) nominal frame; inside a gap it is no measurement
    deviation_mm: Floats  # (NODES,) signed distance to the nominal section, positive outside
    gaps: tuple[Gap, ...]
    zones: tuple[ZoneArc, ...]  # of each side
    noise_mm: float  # standard deviation of a typical point about the profile, in the plane
    band_mm: tuple[float, float]  # the heights between which points took part
    band_points: int  # how many
    knots: Knots
    fit: SplineFit
    columns: Floats  # (NODES, 6) of the fit's free part at the nodes
    left_over_mm: Floats  # (NODES,) how far off the profile the points next to each node lie ...
    left_over_sigma_mm: Floats  # ... and how sure that is; inf where there are none

    def open_nodes(self, damaged: bool | None = None, margin_mm: float = 0.0) -> Bools:
        """Nodes inside a gap, or as near to one: any, or only gaps of damage (or of no damage)."""
        arc = self.chart.arc_mm[:-1] + margin_mm
        inside = np.zeros(NODES, bool)
        for gap in self.gaps:
            if damaged is None or gap.in_damage == damaged:
                beyond_mm = (arc - gap.start_mm) % self.chart.perimeter_mm
                inside |= beyond_mm <= gap.width_mm + 2.0 * margin_mm
        return inside

    def covariance(self, gradients: Floats) -> Floats:
        """Covariance (n, n) of n linear functions (n, NODES) of the nodes' normal displacements."""
        spline = self.knots.weights(gradients, self.z_mm)
        return self.fit.covariance(spline, self.columns.T @ gradients.T)

    def node_sigmas(self) -> Floats:
        """Standard uncertainty (NODES,) of the displacement of each node."""
        u = self.knots.u(np.arange(NODES, dtype=np.float64))
        first = u.astype(np.int64)
        across = self.knots.across(self.z_mm)
        variances = self.fit.variances(first, cubic_weights(u, first), across, self.columns.T)
        return np.sqrt(np.maximum(variances, 0.0))

    @property
    def z_mm(self) -> float:
        return self.chart.section_z_mm


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scan:
    """A scan, taken into the nominal frame where a section asks for it."""

    cloud: Cloud
    mask: Bools  # (n,) True = damaged
    T_nominal_scan: Floats
    z_mm: Floats  # (n,) heights in the nominal frame

    def between(self, low_mm: float, high_mm: float) -> Ints:
        """Numbers of the points from one height to another, both included."""
        return np.flatnonzero((self.z_mm >= low_mm) & (self.z_mm <= high_mm))

    def points_mm(self, numbers: Ints) -> Floats:
        """These points (k, 3), nominal frame."""
        return apply(self.T_nominal_scan, self.cloud.points_mm.take(numbers, axis=0))


def scan_of(cloud: Cloud, mask: Bools, T_nominal_scan: Floats) -> Scan:
    """A cloud as sections are cut from it."""
    z_mm = cloud.points_mm @ T_nominal_scan[2, :3] + T_nominal_scan[2, 3]
    return Scan(cloud=cloud, mask=mask, T_nominal_scan=T_nominal_scan, z_mm=z_mm)


def reconstruct(scan: Scan, chart: Chart, settings: SectionSettings) -> Profile:
    """The profile in the chart's plane. Damaged points take no part.

    Raises `CannotMeasure` when too few sound points lie near the plane.
    """
    near = scan.between(float(chart.z_mm[0]), float(chart.z_mm[-1]))
    near = near[~scan.mask.take(near)]
    z = scan.z_mm.take(near)
    low, high = band_of(chart, z, settings)
    inside = near[(z >= low) & (z <= high)]
    if len(inside) < settings.min_points:
        raise CannotMeasure(f"no sound points within {settings.band_mm:g} mm of the plane")
    sound = scan.points_mm(inside)
    nominal, motion = chart, find_motion(chart, sound)
    chart = with_worn_edges(nominal, motion, sound)
    band = onto_chart(sound, scan.cloud.sigma_mm.take(inside), chart, motion, settings)
    if len(band.node) < settings.min_points:
        raise CannotMeasure("no sound points near the nominal section")
    keep, knots, fit = robust_fit(band, chart, (low, high), settings)
    close = np.abs(band.z_mm - chart.section_z_mm) <= settings.max_gap_mm / 2.0
    arc = _supporting(chart.arc_at(band.node[close]), keep[close], settings.max_gap_mm)
    widest = _widest(chart.perimeter_mm, len(arc), settings)
    used = band.z_mm[keep]
    noise_mm = float(np.sqrt(fit.scale)) * float(np.median(band.few().sigma_mm))
    curve_mm, columns = _drawn(chart, motion, knots, fit, noise_mm)
    height_mm = np.full(NODES, chart.section_z_mm)
    left_over_mm, left_over_sigma_mm = left_over(band, knots, fit, chart)
    return Profile(
        chart=chart,
        curve_mm=curve_mm,
        deviation_mm=nominal.project(np.column_stack([curve_mm, height_mm]))[:, 1],
        gaps=find_gaps(chart, arc, widest),
        zones=cover_zones(chart.curve_mm, chart.side, arc, widest),
        noise_mm=noise_mm,
        band_mm=(float(used.min()), float(used.max())),
        band_points=len(used),
        knots=knots,
        fit=fit,
        columns=columns,
        left_over_mm=left_over_mm,
        left_over_sigma_mm=left_over_sigma_mm,
    )


def _drawn(
    chart: Chart, motion: Motion, knots: Knots, fit: SplineFit, noise_mm: float
) -> tuple[Floats, Floats]:
    """The curve (NODES, 2) of a fit, taken back to where the part is, and the fit's free part at its nodes.

    Noise along the surface lifts points off a bent one by half its variance over the radius: taken off again.
    """
    normals = broad_normals(chart.curve_mm)
    columns = rigid_columns(chart.curve_mm, normals, motion.pivot_mm, np.zeros(NODES))
    height = np.full(NODES, chart.section_z_mm)
    deviation = fit.values(knots.u(np.arange(NODES, dtype=np.float64)), knots.v(height), columns)
    deviation = deviation - 0.5 * noise_mm**2 * curvature(chart.curve_mm)
    return motion.do(chart.curve_mm + normals * deviation[:, None]), columns


def _widest(perimeter_mm: float, count: int, settings: SectionSettings) -> float:
    """The widest arc without a point that is no gap, of a section on which `count` points lie.

    Of points that fall at random one section in a thousand leaves a wider one: mean distance times
    log(count) + 7.
    """
    chance = perimeter_mm / max(count, 1) * (np.log(max(count, 1)) + 7.0)
    return float(min(settings.max_gap_mm, max(settings.gap_share * perimeter_mm, chance)))


def _supporting(arc_mm: Floats, keep: Bools, width_mm: float) -> Floats:
    """Arcs of the kept points where most points within `width_mm` were kept.

    Where the profile passes most points by, those that it meets by chance do not support it.
    """
    order = np.argsort(arc_mm)
    arc, kept = arc_mm[order], keep[order]
    supported = np.concatenate([[0], np.cumsum(kept)])
    first, last = (np.searchsorted(arc, arc[kept] + half) for half in (-0.5 * width_mm, 0.5 * width_mm))
    return arc[kept][2 * (supported[last] - supported[first]) >= last - first]


def whole_gap(chart: Chart) -> tuple[Gap, ...]:
    """The one gap of a section without points."""
    return (Gap(start_mm=0.0, width_mm=chart.perimeter_mm, in_damage=False),)


def find_gaps(chart: Chart, arc_mm: Floats, max_gap_mm: float) -> tuple[Gap, ...]:
    """The arcs wider than `max_gap_mm` between neighbouring points at `arc_mm` (n,), in order."""
    if len(arc_mm) == 0:
        return whole_gap(chart)
    arc = np.sort(arc_mm)
    width = np.diff(arc, append=arc[0] + chart.perimeter_mm)
    wide = np.flatnonzero(~(width <= max_gap_mm))
    return tuple(Gap(start_mm=float(arc[i]), width_mm=float(width[i]), in_damage=False) for i in wide)


def cover_zones(curve_mm: Floats, side: Ints, arc_mm: Floats, max_gap_mm: float) -> tuple[ZoneArc, ...]:
    """How each side (0 .. 3) of a curve is covered by points at `arc_mm` (n,), as `find_gaps` counts it."""
    step = np.linalg.norm(np.roll(curve_mm, -1, axis=0) - curve_mm, axis=1)
    ends = np.concatenate([[0.0], np.cumsum(step)])
    arc = np.sort(arc_mm)
    width = np.diff(arc, append=arc[:1] + ends[-1])
    zones = []
    for index in range(4):
        inside = np.concatenate([[0.0], np.cumsum(step * (side == index))])
        before = np.interp(arc, ends, inside)
        missing = np.diff(before, append=before[:1] + inside[-1]) if len(arc) else inside[-1:]
        wide = ~(width <= max_gap_mm) if len(arc) else np.ones(1, bool)
        whole = float(inside[-1])
        covered = 1.0 - float(missing[wide].sum()) / whole if whole > 0.0 else 1.0
        zones.append(ZoneArc(covered_fraction=max(0.0, covered), largest_gap_mm=float(missing.max())))
    return tuple(zones)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surroundings:
    """Scan points about a section, unrolled: arc, height over the plane, damaged or not."""

    perimeter_mm: float
    arc_mm: Floats
    height_mm: Floats
    damaged: Bools

    def meets_damage(self, arc_mm: float, width_mm: float) -> bool:
        """Along the span from this arc, up and down, what comes first is mostly damage.

        A side without points is as good, so that a broken-off tip is seen from below.
        """
        half = 0.5 * self.perimeter_mm
        column = np.abs((self.arc_mm - arc_mm + half) % self.perimeter_mm - half) <= width_mm / 2.0
        height, damaged = self.height_mm[column], self.damaged[column]
        sides = []
        for side in (height < 0.0, height >= 0.0):
            nearest = np.argsort(np.abs(height[side]))[:10]
            if len(nearest) >= 5:
                sides.append(float(damaged[side][nearest].mean()) >= 0.5)
        return bool(sides) and all(sides)


def explain_gaps(
    gaps: tuple[Gap, ...], scan: Scan, nominal: Nominal, z_mm: float, settings: SectionSettings
) -> tuple[Gap, ...]:
    """The gaps, those marked that damage borders on most of their width: the broken surface or its rim."""
    if not gaps or not scan.mask.any():
        return gaps
    chart = unroll(nominal, z_mm, settings.damage_reach_mm, settings)
    inside = scan.between(float(chart.z_mm[0]), float(chart.z_mm[-1]))
    around = Surroundings(
        perimeter_mm=chart.perimeter_mm,
        arc_mm=chart.arc_at(chart.project(scan.points_mm(inside))[:, 0]),
        height_mm=scan.z_mm[inside] - z_mm,
        damaged=scan.mask[inside],
    )
    return tuple(replace(gap, in_damage=_in_damage(gap, around, settings.max_gap_mm)) for gap in gaps)


def _in_damage(gap: Gap, around: Surroundings, width_mm: float) -> bool:
    """At least half of the gap's columns, about `width_mm` wide, meet damage."""
    count = max(1, round(gap.width_mm / width_mm))
    centres = gap.start_mm + gap.width_mm * (np.arange(count) + 0.5) / count
    return 2 * sum(around.meets_damage(float(centre), width_mm) for centre in centres) >= count
