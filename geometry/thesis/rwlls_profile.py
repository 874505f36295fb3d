"""Sectional points without order -> the closed section profile, as in chapter 4 of the thesis.

Nearby points are taken along the surface into the plane, thinned by recursive weighted local least squares
whose domains grow while the residuals stay within the measurement uncertainty, ordered by a polygon that
follows the thinned points' normals, and smoothed by a closed cubic B-spline of as few segments as
the uncertainty of the thinned points allows. Nothing is asked of a user, nor of the nominal.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from geometry.errors import BadInput, CannotMeasure
from geometry.kernels.quadric import balanced_quadrics
from geometry.kernels.rwlls import blend_curves, grow_domains, pull_back
from geometry.kernels.rwlls_spline import cubic_basis, fit_progressively
from geometry.sections.chart import outward_normals
from geometry.thesis.polygon import order_points
from geometry.types import Floats, Ints

_CANDIDATES, _SECTORS, _PER_SECTOR = 30, 8, 2  # of the balanced neighbourhood, as `surface.local_shape`
_SOME = 400  # points whose spacing stands for all
_PROBES = 20  # thinned points whose own uncertainty stands for all
_OUTLIER = 6.0  # robust standard deviations
_WINDOWS = 40  # of the profile, to find where its curvature varies least


@dataclass(frozen=True, slots=True, kw_only=True)
class RwllsSettings:
    """How a profile is reconstructed from sectional points."""

    slab_spacings: float = 0.9  # half thickness of the slab: at 0.1 mm spacing about 1,700 points (table 4.2)
    upright: float = 0.7  # least horizontal part of a unit normal that belongs to a profile
    growth: float = (
        3.0**0.5
    )  # u of equation 4.6 over that along the normal: the thesis' noise has any direction
    most_neighbours: int = 128  # of a domain
    most_segments: int = 400
    max_gap_mm: float = 1.5  # a longer side of the polygon is no profile
    min_points: int = 60

    def __post_init__(self) -> None:
        lengths = (self.slab_spacings, self.growth, self.max_gap_mm)
        if not all(np.isfinite(x) and x > 0.0 for x in lengths):
            raise BadInput(f"sectional points: {self} has a length that is none")
        if not (0.0 < self.upright < 1.0 and self.min_points >= 20 and self.most_neighbours >= 10):
            raise BadInput(f"sectional points: {self} contradicts itself")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sectional:
    """Points brought into the plane: places, unit normals (n, 2) of either sign, weights of equation 4.4."""

    points_mm: Floats  # (n, 2)
    normals: Floats  # (n, 2)
    weights: Floats  # (n,)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Thinned:
    """Sectional points on the mean of the curves through them, and what is known of each."""

    sectional: Sectional
    members: Ints  # (n, k) domains
    size: Ints  # (n,)
    points_mm: Floats  # (n, 2)
    normals: Floats  # (n, 2)
    spread_mm: Floats  # (n,) of the curves about their mean
    curvature_per_mm: Floats  # (n,) of each point's own curve

    def pull_back(self, functions: Floats) -> Floats:
        """(n, f): growth with the sectional points' displacements of functions of the thinned points."""
        given = self.sectional
        return pull_back(given.points_mm, given.normals, given.weights, self.members, self.size, functions)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClosedProfile:
    """A reconstructed profile: a closed cubic B-spline over t in [0, 1), counter-clockwise.

    `order` are the thinned points that it passes near, at ascending parameters `t`.
    """

    thinned: Thinned
    order: Ints  # (k,)
    t: Floats  # (k,)
    knots: Floats  # (m + 7,)
    control_mm: Floats  # (m, 2)
    noise_mm: float  # standard deviation of the sectional points about the thinned ones
    rms_mm: float  # of the thinned points about the spline

    def basis(self, t: Floats) -> csr_array:
        """(len(t), m): the splines at ascending parameters."""
        first, values = cubic_basis(self.knots, t)
        columns = (first[:, None] + np.arange(4)) % len(self.control_mm)
        row = np.repeat(np.arange(len(t)), 4)
        return csr_array((values.ravel(), (row, columns.ravel())), shape=(len(t), len(self.control_mm)))

    def curve_mm(self, t: Floats) -> Floats:
        """Points (len(t), 2) at ascending parameters."""
        return np.asarray(self.basis(t) @ self.control_mm)

    def growth(self, t: Floats, normals: Floats, gradients: Floats) -> Floats:
        """(n, f): growth of functions of the curve with the sectional points' displacements along normals.

        `gradients` (f, len(t)): their growth with displacements of the curve at `t` along `normals`.
        """
        fit, at = self.basis(self.t), self.basis(t)
        gram = (fit.T @ fit).toarray()
        own = self.thinned.normals[self.order]
        functions = np.zeros((len(self.thinned.points_mm), len(gradients)))
        for axis in (0, 1):
            control = np.linalg.solve(gram, at.T @ (normals[:, axis, None] * gradients.T))
            functions[self.order] += own[:, axis, None] * (fit @ control)
        return self.thinned.pull_back(functions)

    def misfit_mm(self, t: Floats) -> Floats:
        """What parabolas and spline may miss of the profile, standard deviation (len(t),).

        Over two segments: the scatter of the curves about each thinned point, how far the spline passes
        these, and how far it passes the mean of the sectional points, noise included. And what may lie
        between two points where the profile turns: half the sagitta of an arc that turns as their normals do.
        """
        thinned, order = self.thinned, self.order
        half = max(2, len(order) // len(self.control_mm))
        here, normals = self.curve_mm(self.t), thinned.normals[order]
        passed = ((thinned.points_mm[order] - here) * normals).sum(axis=1)
        missed = ((thinned.sectional.points_mm[order] - here) * normals).sum(axis=1)
        square = thinned.spread_mm[order] ** 2 + passed**2
        total = _around(square, half).mean(axis=1) + _around(missed, half).mean(axis=1) ** 2
        return np.interp(t, self.t, np.sqrt(total + self._bulge_mm() ** 2), period=1.0)

    def _bulge_mm(self) -> Floats:
        """Half the sagitta (k,) of the larger of the two arcs beside each ordered point."""
        points, normals = self.thinned.points_mm[self.order], self.thinned.normals[self.order]
        outward = normals * np.sign((normals * outward_normals(points)).sum(axis=1))[:, None]
        turn = np.arccos(np.clip((outward * np.roll(outward, -1, axis=0)).sum(axis=1), -1.0, 1.0))
        after = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1) * turn / 16.0
        return np.maximum(after, np.roll(after, 1))


def _around(values: Floats, half: int) -> Floats:
    """(n, 2 half + 1): each of the values of a closed row with its neighbours on either side."""
    return np.lib.stride_tricks.sliding_window_view(np.pad(values, half, mode="wrap"), 2 * half + 1)


def reconstruct_thesis(
    points_mm: Floats, z_mm: float, uncertainty_mm: float, settings: RwllsSettings = RwllsSettings()
) -> ClosedProfile:
    """The profile in the plane `z_mm` from points (n, 3) on both sides of it, nominal frame.

    `uncertainty_mm`: standard uncertainty of a point along the surface normal.
    Raises `CannotMeasure` for too few points, or where they do not close.
    """
    if not (np.isfinite(uncertainty_mm) and uncertainty_mm > 0.0):
        raise BadInput(f"sectional points: an uncertainty of {uncertainty_mm} mm")
    sectional = take_into_plane(points_mm, z_mm, settings)
    thinned = thin(sectional, uncertainty_mm, settings)
    order = order_points(thinned.points_mm, thinned.normals)
    return _smooth(thinned, _from_calm_start(thinned, order), uncertainty_mm, settings)


def take_into_plane(points_mm: Floats, z_mm: float, settings: RwllsSettings) -> Sectional:
    """The points near the plane, moved into it along the surface, with their sectional normals and weights.

    The surface is each point's local quadric over a balanced neighbourhood; its tangent plane is followed.
    Source: thesis 4.3.1, after Khameneifar and Feng (its reference 9).
    """
    if len(points_mm) < settings.min_points:
        raise CannotMeasure(f"{len(points_mm)} points near the plane are fewer than {settings.min_points}")
    tree = cKDTree(points_mm)
    half_mm = settings.slab_spacings * _spacing_mm(tree)
    slab = np.flatnonzero(np.abs(points_mm[:, 2] - z_mm) <= half_mm)
    places, nearest = _slab_first(tree, slab)
    balanced, looks, _, _, _ = balanced_quadrics(places, nearest, _SECTORS, _PER_SECTOR)
    level = np.linalg.norm(looks[:, :2], axis=1)
    taken = np.flatnonzero(level >= settings.upright)  # not so where no quadric was determined
    if len(taken) < settings.min_points:
        raise CannotMeasure(f"{len(taken)} points in the plane are fewer than {settings.min_points}")
    normals = looks[taken, :2] / level[taken, None]
    rise = (places[taken, 2] - z_mm) * looks[taken, 2] / level[taken]
    flat = places[taken, :2] + rise[:, None] * normals
    weights = _weights(flat, normals, _within(balanced[taken], taken, len(places)))
    return Sectional(points_mm=flat, normals=normals, weights=weights)


def _spacing_mm(tree: cKDTree) -> float:
    """The side of the square of surface that each point stands for, from the sixteen nearest of some."""
    some = tree.data[:: max(1, len(tree.data) // _SOME)]
    distances_mm = tree.query(some, k=17)[0][:, -1]
    return float(np.median(distances_mm) * np.sqrt(np.pi / 16.0))


def _slab_first(tree: cKDTree, slab: Ints) -> tuple[Floats, Ints]:
    """The tree's points, the slab's first, and the nearest (len(slab), k) of those, themselves first."""
    count = len(tree.data)
    others = np.setdiff1d(np.arange(count), slab, assume_unique=True)
    order = np.concatenate([slab, others])
    place = np.empty(count, np.int64)
    place[order] = np.arange(count)
    nearest = tree.query(tree.data[slab], k=min(_CANDIDATES, count))[1]
    return np.ascontiguousarray(tree.data[order]), place[nearest]


def _within(neighbours: Ints, taken: Ints, count: int) -> Ints:
    """The neighbours (n, k) as indices into `taken`; -1 for those not taken."""
    place = np.full(count + 1, -1)
    place[taken] = np.arange(len(taken))
    return place[neighbours]


def _weights(points_mm: Floats, normals: Floats, neighbours: Ints) -> Floats:
    """The weight (n,) of each point by its outlier factor; 0 where fewer than two neighbours tell it.

    Source: thesis equations 4.1 to 4.4.
    """
    there = neighbours >= 0
    along = np.einsum("nkj,nj->nk", points_mm[neighbours] - points_mm[:, None], normals)
    count = there.sum(axis=1)
    known = count >= 2
    distance = np.where(there, np.abs(along), 0.0).sum(axis=1) / np.maximum(count, 1)
    pairs = there[:, :, None] & there[:, None, :]
    inner = np.where(pairs, np.abs(along[:, :, None] - along[:, None, :]), 0.0).sum(axis=(1, 2))
    factor = distance / np.maximum(inner / np.maximum(count * (count - 1), 1), 1e-12)
    deviation = max(float(factor[known].std()), 1e-12) if known.any() else 1.0
    return np.where(known, np.exp(-factor / deviation), 0.0)


def thin(sectional: Sectional, uncertainty_mm: float, settings: RwllsSettings) -> Thinned:
    """The sectional points thinned. Source: thesis 4.3.2."""
    points, normals = sectional.points_mm, sectional.normals
    nearest = cKDTree(points).query(points, k=min(settings.most_neighbours, len(points)))[1]
    limit = settings.growth * uncertainty_mm
    members, size, curves = grow_domains(points, normals, sectional.weights, nearest, limit)
    thinned, filtered, spread, _ = blend_curves(points, normals, members, size, curves)
    return Thinned(
        sectional=sectional,
        members=members,
        size=size,
        points_mm=thinned,
        normals=filtered,
        spread_mm=spread,
        curvature_per_mm=2.0 * np.abs(curves[:, 2]) / (1.0 + curves[:, 1] ** 2) ** 1.5,
    )


def _from_calm_start(thinned: Thinned, order: Ints) -> Ints:
    """The loop counter-clockwise, from where its curvature varies least.

    Source: thesis 4.3.3, after Khameneifar and Feng (its reference 84).
    """
    x, y = thinned.points_mm[order].T
    if x @ np.roll(y, -1) < np.roll(x, -1) @ y:
        order = order[::-1]
    half = max(2, len(order) // _WINDOWS)
    windows = _around(thinned.curvature_per_mm[order], half)
    return np.roll(order, -int(np.argmin(windows.var(axis=1))))


def _smooth(thinned: Thinned, order: Ints, uncertainty_mm: float, settings: RwllsSettings) -> ClosedProfile:
    """The B-spline through the ordered points, of as few segments as their own uncertainty allows.

    The thesis stops at the rms of u, the uncertainty of a measured point. What is fitted here are the thinned
    points, several times as certain: at u the sides would pay for edges that are missed by several u. Where
    even the most segments do not come so near, u is what they must come within.
    """
    points = np.ascontiguousarray(thinned.points_mm[order])
    sides = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    if not sides.max() <= settings.max_gap_mm:
        raise CannotMeasure(f"no points on {sides.max():.1f} mm of the profile")
    t = np.concatenate([[0.0], np.cumsum(sides)[:-1]]) / sides.sum()
    limit = uncertainty_mm * _certainty(thinned, order)
    most = min(settings.most_segments, len(order) // 2)
    knots, control, rms = fit_progressively(t, points, limit, most)
    if not rms < uncertainty_mm:
        raise CannotMeasure(f"no spline of {most} segments is within {uncertainty_mm:.4f} mm of the profile")
    return ClosedProfile(
        thinned=thinned,
        order=order,
        t=t,
        knots=knots,
        control_mm=control,
        noise_mm=_noise_mm(thinned),
        rms_mm=rms,
    )


def _certainty(thinned: Thinned, order: Ints) -> float:
    """Standard uncertainty of a thinned point over that of a sectional one: root mean square over a few."""
    probes = order[:: max(1, len(order) // _PROBES)]
    unit = np.zeros((len(thinned.points_mm), len(probes)))
    unit[probes, np.arange(len(probes))] = 1.0
    return float(np.sqrt((thinned.pull_back(unit) ** 2).sum() / len(probes)))


def _noise_mm(thinned: Thinned) -> float:
    """Standard deviation of sectional points about thinned ones, along the normals, outliers apart."""
    off = np.abs(((thinned.sectional.points_mm - thinned.points_mm) * thinned.normals).sum(axis=1))
    return float(np.sqrt(np.mean(off[off <= _OUTLIER * 1.4826 * np.median(off)] ** 2)))
