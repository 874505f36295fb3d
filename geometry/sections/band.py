"""Sound points near a section, laid on the chart, and the smooth deviation through them.

The deviation is a cubic tensor spline over arc length and a band of neighbouring z, penalised by its
curvature in both directions; how strongly is estimated from the data (restricted maximum likelihood),
apart for the edges, which erode, and the sides. A section as a whole bends off less than its form does:
how much its motion may curve along the span is estimated apart.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.sparse import csr_array

from geometry.kernels.graph import window_medians
from geometry.kernels.profile_spline import (
    Penalty,
    SplineFit,
    Sums,
    curvature_penalty,
    eliminate,
    fit_spline,
    gather,
)
from geometry.kernels.tensor_spline import band_bins, band_misfit, cubic_weights
from geometry.sections.chart import NODES, Chart, SectionSettings, edge_width, outward_normals
from geometry.sections.curve import centroid, centroid_gradient, node_shares
from geometry.sections.motion import Motion
from geometry.types import Bools, Floats

_PILOT_POINTS = 10_000  # of a band, to tell outliers ...
_BENDING_PER_MM = np.array([5e-3, 2e-1, 5e-4])  # of what is told from outliers: sides, edges, along the span
_START = np.array([5e4, 5e4, 1e8])  # of the search for the strengths: those of a blade in service
_RIGID_PRIOR = np.array([0.3, 0.3, 0.02, 0.3, 0.3, 0.02]) ** -2.0  # weak: `find_motion` has taken most
_PILOT_BINS = (2, 4)  # ... in each knot span along the arc, and across
_BINS = (4, 4)  # the same for all points
_NEXT_MM, _NEXT_POINTS = 0.4, 5  # along the arc and the span, of points that lie next to a node; at least
_MEDIAN = 1.2533  # standard error of a median over that of a mean
_LIKELIER = 9.0, 9.0, 0.0  # x, y, turn: twice the gain in log likelihood that makes a motion curve
_ARM_MM = 10.0  # a turn counts as the movement of a point so far from the centroid


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Knots:
    """Where the deviation spline of one band has its coefficients: p along the arc, q across."""

    p: int
    q: int
    low_mm: float
    step_mm: float

    def u(self, node: Floats) -> Floats:
        """Knot spans of node coordinates."""
        return node * (self.p / NODES)

    def v(self, z_mm: Floats) -> Floats:
        """Knot spans of heights."""
        return (z_mm - self.low_mm) / self.step_mm

    def across(self, z_mm: float) -> Floats:
        """Weights (q,) of the coefficients of a row at a height."""
        v = self.v(np.array([z_mm]))
        first = np.clip(v.astype(np.int64), 0, self.q - 4)
        across = np.zeros(self.q)
        across[first[0] : first[0] + 4] = cubic_weights(v, first)[0]
        return across

    def weights(self, gradients: Floats, z_mm: float) -> Floats:
        """Weights (p, q, n) of the coefficients in n functions (n, NODES) of the node displacements."""
        weights: Floats = self.along(gradients)[:, None, :] * self.across(z_mm)[:, None]
        return weights

    def along(self, gradients: Floats) -> Floats:
        """Weights (p, n) of one row of coefficients in the same functions."""
        weights: Floats = _basis(self.p).T @ gradients.T
        return weights


@lru_cache(maxsize=16)
def _basis(p: int) -> csr_array:
    """The splines (NODES, p) of the closed arc at the nodes."""
    u = np.arange(NODES) * (p / NODES)
    span = u.astype(np.int64)
    column = (span[:, None] + np.arange(4)) % p
    row = np.repeat(np.arange(NODES), 4)
    return csr_array((cubic_weights(u, span).ravel(), (row, column.ravel())), shape=(NODES, p))


def place_knots(chart: Chart, span_mm: tuple[float, float], settings: SectionSettings) -> Knots:
    """Knots that crowd at the edges as the nodes do, `knot_mm` apart on the sides, over heights `span_mm`."""
    half = chart.perimeter_mm / 2.0
    refined = half + 1.77 * (settings.edge_refinement - 1.0) * edge_width(half, settings)
    p = 2 * max(8, round(refined / settings.knot_mm))
    low, high = span_mm
    spans = min(max(1, round((high - low) / settings.z_knot_mm)), settings.most_z_spans)
    return Knots(p=min(p, NODES // 4), q=spans + 3, low_mm=low, step_mm=(high - low) / spans)


def _penalty(chart: Chart, knots: Knots, settings: SectionSettings) -> Penalty:
    """Curvature along the arc, apart for sides (0) and edges (1), and across."""
    spans = np.arange(knots.p, dtype=np.float64)
    centre = chart.arc_at((spans - 1.0) % knots.p * (NODES / knots.p))
    leading = chart.arc_mm[NODES // 2]
    trailing = np.minimum(centre, chart.perimeter_mm - centre)
    reach = 1.5 * edge_width(chart.perimeter_mm / 2.0, settings)
    group = (np.minimum(np.abs(centre - leading), trailing) < reach).astype(np.int64)
    return curvature_penalty(centre, chart.perimeter_mm, group, knots.q, knots.step_mm)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Band:
    """Sound points near a section, taken back onto the chart."""

    node: Floats  # (n,) node coordinate
    z_mm: Floats
    sigma_mm: Floats
    rows: Floats  # (n, 6) signed distance, arm x, y, outward normal x, y, height in half widths of the band

    def few(self) -> "Band":
        """A share of the points, evenly through them."""
        return self.of(slice(None, None, max(1, len(self.node) // _PILOT_POINTS)))

    def of(self, chosen: Bools | slice) -> "Band":
        """The chosen points."""
        return Band(
            node=self.node[chosen],
            z_mm=self.z_mm[chosen],
            sigma_mm=self.sigma_mm[chosen],
            rows=np.ascontiguousarray(self.rows[chosen]),
        )

    def laid(self, knots: Knots) -> "LaidBand":
        return LaidBand(band=self, knots=knots, u=knots.u(self.node), v=knots.v(self.z_mm))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LaidBand:
    """A band on the knots of its spline."""

    band: Band
    knots: Knots
    u: Floats
    v: Floats

    def sums(self, keep: Bools, penalty: Penalty, bins_a_span: tuple[int, int]) -> Sums:
        """Weighted sums of some points: the means of small bins stand for the points in them."""
        rows, knots = self.band.rows, self.knots
        weight = keep / np.square(self.band.sigma_mm)
        bins = band_bins(self.u, self.v, rows, weight, (knots.p, knots.q - 3), bins_a_span)
        sums = gather(bins[:, 0], bins[:, 1], bins[:, 3], bins[:, 2], bins[:, 4:], penalty.layout)
        return replace(
            sums,
            free=sums.free + np.diag(_RIGID_PRIOR),
            square=float(weight @ rows[:, 0] ** 2),
            count=int(np.count_nonzero(keep)),
        )

    def off_mm(self, coefficients: Floats, free: Floats) -> Floats:
        """Signed distance from a fit."""
        off_mm: Floats = band_misfit(self.u, self.v, self.band.rows, coefficients, free)
        return off_mm

    def misfit(self, coefficients: Floats, free: Floats) -> Floats:
        """Distance from a fit in units of each point's sigma."""
        return np.abs(self.off_mm(coefficients, free)) / self.band.sigma_mm


def band_of(chart: Chart, z_mm: Floats, settings: SectionSettings) -> tuple[float, float]:
    """From what height to what height points at `z_mm` (n,) take part: the sparser they are, the farther.

    So the centroid of a sparse scan, too, has as much metal to stand on as it needs.
    """
    low, high = _limits(chart, settings.band_mm)
    count = max(int(np.count_nonzero((z_mm >= low) & (z_mm <= high))), 1)
    spacing_mm = np.sqrt((high - low) * chart.perimeter_mm / count)
    half = float(np.clip(settings.band_spacings * spacing_mm, settings.band_mm, settings.widest_band_mm))
    return _limits(chart, half)


def _limits(chart: Chart, half_mm: float) -> tuple[float, float]:
    """The heights of a band, as far as the chart goes."""
    low, high = chart.section_z_mm - half_mm, chart.section_z_mm + half_mm
    return max(low, float(chart.z_mm[0])), min(high, float(chart.z_mm[-1]))


def onto_chart(
    points_mm: Floats, sigma_mm: Floats, chart: Chart, motion: Motion, settings: SectionSettings
) -> Band:
    """The points within `capture_mm` of the moved nominal, where it stands upright enough.

    On a slanted surface the distance in the plane is longer than along the normal, and so is its sigma.
    """
    limits = settings.capture_mm, settings.steepest
    node, z_mm, sigma_mm, rows = chart.lay(points_mm, sigma_mm, motion.terms, limits)
    rows[:, 5] /= settings.band_mm
    return Band(node=node, z_mm=z_mm, sigma_mm=sigma_mm, rows=rows)


def robust_fit(
    band: Band, chart: Chart, span_mm: tuple[float, float], settings: SectionSettings
) -> tuple[Bools, Knots, SplineFit]:
    """Which points the profile passes through, the knots, and the fit to these points.

    What is kept is decided on a share of the points and a fixed smoothness; the last fit takes them all.
    """
    knots = place_knots(chart, span_mm, settings)
    penalty = _penalty(chart, knots, settings)
    laid = band.laid(knots)
    few = band.few().laid(knots)
    keep = np.ones(len(few.u), bool)
    for limit in (2.0 * settings.outlier, settings.outlier):
        pilot = eliminate(few.sums(keep, penalty, _PILOT_BINS), penalty, _BENDING_PER_MM**-2.0)
        coefficients = pilot.values(penalty.layout)
        misfit = few.misfit(coefficients, pilot.free)
        most = limit * 1.4826 * float(np.median(misfit))
        keep = misfit <= most
    keep = laid.misfit(coefficients, pilot.free) <= most
    fit = fit_spline(laid.sums(keep, penalty, _BINS), penalty, _START)
    return keep, knots, _steadied(fit, knots, chart.curve_mm)


def left_over(band: Band, knots: Knots, fit: SplineFit, chart: Chart) -> tuple[Floats, Floats]:
    """How far off the fit the points next to each node (NODES,) of the section lie, and how sure that is.

    The median of all near points, kept or not; sigma is inf where there are hardly any. One strength of
    smoothing for all sides, and one for the edges, flattens what bends more sharply than they do as a
    rule: at the rim of a break, or a scratch. The fit's own covariance does not know.
    """
    near = band.of(np.abs(band.z_mm - chart.section_z_mm) <= _NEXT_MM)
    arc_mm = chart.arc_at(near.node)
    order = np.argsort(arc_mm)
    off_mm = np.tile(near.laid(knots).off_mm(fit.coefficients, fit.free)[order], 3)
    variance_mm2 = fit.scale * np.tile(near.sigma_mm[order] ** 2, 3)
    laps_mm = np.concatenate([arc_mm[order] + lap * chart.perimeter_mm for lap in (-1.0, 0.0, 1.0)])
    middles_mm = np.linspace(0.0, chart.perimeter_mm, max(2, round(chart.perimeter_mm / _NEXT_MM)) + 1)
    windows = np.searchsorted(laps_mm, middles_mm + np.array([[-_NEXT_MM], [_NEXT_MM]]))
    left_mm, mean_mm2, count = window_medians(off_mm, variance_mm2, windows)
    enough = count >= _NEXT_POINTS
    left_mm[~enough] = 0.0
    sigma_mm = np.where(enough, _MEDIAN * np.sqrt(mean_mm2 / np.maximum(count, 1)), np.inf)
    nearest = np.rint(chart.arc_mm[:-1] / middles_mm[1]).astype(np.int64)
    return left_mm[nearest], sigma_mm[nearest]


def _steadied(fit: SplineFit, knots: Knots, nominal_mm: Floats) -> SplineFit:
    """The fit with the motion of whole sections along the span as straight as the data allow.

    Centroid and turn are sums over the whole arc; left as free to curve as the form beside them, they would
    be no better than a few mm of height make them. Their second differences along z are taken for
    draws of one variance each, which maximum likelihood gives; a centroid, which noise bends more readily
    than wear does, curves only where that is three standard deviations' worth.
    """
    bend = np.diff(np.eye(knots.q), 2, axis=0)
    along = knots.along(_motion_gradients(nominal_mm))
    weights = (along[:, None, :, None] * bend.T[None, :, None, :]).reshape(knots.p, knots.q, -1)
    curved = np.einsum("pq,pqn->n", fit.coefficients, weights)
    covariance = fit.covariance(weights, np.zeros((0, len(curved))))
    blocks = np.arange(len(curved)).reshape(3, -1)
    variance = [
        _excess(curved[block], covariance[np.ix_(block, block)], likelier)
        for block, likelier in zip(blocks, _LIKELIER, strict=True)
    ]
    return fit.held(weights, np.repeat(variance, blocks.shape[1]))


def _motion_gradients(nominal_mm: Floats) -> Floats:
    """(3, NODES): growth of centroid x, y and of the turn times `_ARM_MM` with the nodes' displacements."""
    arm, normals = nominal_mm - centroid(nominal_mm), outward_normals(nominal_mm)
    lever = node_shares(nominal_mm) * (normals[:, 1] * arm[:, 0] - normals[:, 0] * arm[:, 1])
    weighted = lever / node_shares(nominal_mm)
    return np.vstack([centroid_gradient(nominal_mm), _ARM_MM * lever / float(lever @ weighted)])


def _excess(values: Floats, covariance: Floats, likelier: float) -> float:
    """The variance of independent draws that, seen with a `covariance`, most likely give the values.

    None, unless twice the log likelihood is by `likelier` above that of noise alone.
    """
    noise, axes = np.linalg.eigh(covariance)
    noise = np.maximum(noise, 1e-9 * noise[-1])
    square = (axes.T @ values) ** 2
    tried = np.concatenate([[1e-6], np.logspace(-2.0, 5.0, 57)]) * float(noise.mean())
    total = noise + tried[:, None]
    cost = np.log(total).sum(axis=1) + (square / total).sum(axis=1)
    best = int(np.argmin(cost))
    return float(tried[best if cost[best] < cost[0] - likelier else 0])
