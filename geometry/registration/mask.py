"""Which points of an aligned cloud lie on damage: off the nominal, and abruptly so."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from geometry.blade.nominal import of_end_faces
from geometry.errors import BadInput
from geometry.kernels.form import blend, local_fits
from geometry.kernels.graph import dilate, grow, neighbourhood_mean, neighbourhood_median
from geometry.kernels.neighbours import cell_index, counting_sort
from geometry.kernels.parts import over_parts
from geometry.robust import robust_sigma
from geometry.scan.neighbourhood import next_to
from geometry.types import Bools, Floats, Ints

TURN_MM = 10.0  # a unit of normal counts as this far, so that the two sides of a thin edge are apart
BLENDED = 6  # nodes around a point whose local fits are blended there
CELL = 1.6  # edge of a cell of the nodes, as wide as most of these reach and a little
IRLS_STEPS = 4
RIDGE = 1e-3  # flat surfaces do not tell all motions
REACHES = 6
LIDS = 10  # part of the points for the form, at least, that may lie on end faces
LOOKED_AT = 4  # times as many points as are taken for the form
TRIES = 4  # for the size of a cell that takes one
HASH = np.array([73856093, 19349663, 83492791, 49979687, 86028121, 67867979])  # of a cell's six coordinates
MEDIAN = 1.25  # a median scatters so much more than a mean


@dataclass(frozen=True, slots=True, kw_only=True)
class MaskSettings:
    neighbours: int = 16
    high: float = 4.5  # of the scale: certainly damaged; of a million points noise takes a few so far
    low: float = 2.2  # damaged if joined to what certainly is
    own: float = 3.0  # of the scatter of single points: sound if its neighbours are
    ring: int = 5  # nearest neighbours of damage that are damage too
    shallow_mm: float = 0.02  # of a neighbourhood: a rim that is further off stays damage
    exact_mm: float = 0.004  # of a neighbourhood: no better is a form known
    form_mm: float = 0.06  # smooth deviations of walls up to this are form, not damage
    end_form_mm: float = 0.15  # and of end faces, whose few points the scatter of all says little of
    rim_mm: float = 2.0  # around points that are further off, where a damage may run out ...
    usual: float = 1.0  # ... unless a point there is no further off than this share of the scatter
    form_points: int = 20_000  # of the cloud, to find them
    form_nodes: int = 1500  # local fits
    form_window: int = 213  # points in each

    def __post_init__(self) -> None:
        if not (self.neighbours >= 4 and 0.0 < self.low <= self.high):
            raise BadInput(f"mask: {self} contradicts itself")
        if not (min(self.own, self.shallow_mm) > 0.0 and self.exact_mm >= 0.0 and self.ring >= 0):
            raise BadInput(f"mask: {self} has no rim")
        if not (min(self.form_mm, self.end_form_mm) > 0.0 and min(self.rim_mm, self.usual) >= 0.0):
            raise BadInput(f"mask: {self} has a distance that is none")
        if not 20 <= self.form_window <= self.form_nodes <= self.form_points:
            raise BadInput(f"mask: {self} has too few points for a form")


def damaged(residual_mm: Floats, neighbours: Ints, floor_mm: float, settings: MaskSettings) -> Bools:
    """The points (n,) whose neighbourhood lies off the surface.

    `residual_mm` (n,) is signed, `neighbours` (n, k) of each point, itself among them. The mean over a
    neighbourhood keeps what damage does and averages noise away; its robust scatter, but at least
    `floor_mm`, is the scale. From seeds beyond `high` scales the flag grows over the neighbour graph down
    to `low`. As the mean carries damage a neighbourhood beyond its rim, points there that are not off
    themselves and most of whose neighbours are not are let go.
    """
    smooth_mm = neighbourhood_mean(residual_mm, neighbours[:, 1:])
    scale_mm = max(robust_sigma(smooth_mm), floor_mm, settings.exact_mm)
    size = np.abs(smooth_mm) / scale_mm
    reached = grow(size > settings.high, size > settings.low, neighbours)
    most_mm = np.abs(neighbourhood_median(residual_mm, neighbours, reached))
    scatter_mm = max(robust_sigma(residual_mm), scale_mm)
    beside = most_mm <= min(settings.low * MEDIAN * scale_mm, settings.shallow_mm)
    let_go = beside & (np.abs(residual_mm) <= settings.own * scatter_mm)
    return np.asarray(reached & ~let_go)


def ringed(damage: Bools, neighbours: Ints, settings: MaskSettings) -> Bools:
    """Damage (n,) with a narrow ring around it: the `ring` nearest neighbours of each of its points."""
    return np.asarray(dilate(damage, np.ascontiguousarray(neighbours[:, : settings.ring + 1])))


def form_of(points_mm: Floats, normals: Floats, distance_mm: Floats, settings: MaskSettings) -> Floats:
    """The smooth part (n,) of the signed distances: what service or making did to the form.

    Local fits over a few millimetres, robust against what is abrupt, blended between their nodes. Points
    further than `form_mm` or `end_form_mm` off, or four robust sigmas of all, take no part, nor do those next
    to them: within a wide damage the form is that of its surroundings. But a break is sharp, and the form
    runs up to it: what lies there as near the nominal as most points do tells it. Where a bent blade leaves
    the nominal smoothly by more, the fits reach out until no more points join.
    """
    place = np.column_stack([points_mm, TURN_MM * normals])
    few = _sampled(place, normals, settings)
    off_mm, scatter_mm = np.abs(distance_mm[few]), robust_sigma(distance_mm)
    ends = of_end_faces(normals[few])
    limit_mm = np.maximum(np.where(ends, settings.end_form_mm, settings.form_mm), 4.0 * scatter_mm)
    near = off_mm <= limit_mm
    for _ in range(REACHES):
        beside = next_to(place[few], ~near, settings.rim_mm) & (off_mm > settings.usual * scatter_mm)
        chosen = few[near & ~beside]
        if len(chosen) < settings.form_window:  # nothing of the nominal's form is left to tell
            return np.zeros(len(points_mm))
        nodes = chosen[_every_nth(len(chosen), settings.form_nodes)]
        _, members = _nearest(place[chosen], place[nodes], settings.form_window)
        fits = local_fits(
            points_mm[nodes], chosen[members], points_mm, normals, distance_mm, IRLS_STEPS, RIDGE
        )
        form_mm = _blend(points_mm[few], normals[few], points_mm[nodes], normals[nodes], fits)
        before, near = near, near | (np.abs(distance_mm[few] - form_mm) <= limit_mm)
        if np.array_equal(before, near):
            break
    return _blend(points_mm, normals, points_mm[nodes], normals[nodes], fits)


def _sampled(place: Floats, normals: Floats, settings: MaskSettings) -> Ints:
    """Indices of points evenly through all, and of more of them on end faces: these are small, and hold z."""
    looked_at = _every_nth(len(place), LOOKED_AT * settings.form_points)
    lid = np.flatnonzero(of_end_faces(normals))
    return np.union1d(
        looked_at[_one_to_a_cell(place[looked_at], settings.form_points)],
        lid[_every_nth(len(lid), settings.form_points // LIDS)],
    )


def _one_to_a_cell(place: Floats, most: int) -> Ints:
    """Indices of about `most` points (n, 6), or of all, even over the surface and over the way it looks.

    A thin edge has little surface but turns far: so it gets its share, and what form it has is not taken
    for damage.
    """
    if len(place) <= most:
        return np.arange(len(place))
    cell_mm = float(np.ptp(place, axis=0).max()) / np.sqrt(most)
    for _ in range(TRIES):
        cells = np.floor(place / cell_mm).astype(np.int64) @ HASH  # two that collide cost one point
        first = np.unique(cells, return_index=True)[1]
        cell_mm *= np.sqrt(len(first) / most)
    return np.sort(first)


def _every_nth(count: int, most: int) -> Ints:
    return np.arange(0, count, max(1, count // most))


def _nearest(targets: Floats, places: Floats, k: int) -> tuple[Floats, Ints]:
    apart, nearest = cKDTree(targets).query(places, k=k)
    return np.asarray(apart, np.float64), np.asarray(nearest, np.int64)


def _blend(
    points_mm: Floats, normals: Floats, nodes_mm: Floats, node_normals: Floats, fits: Floats
) -> Floats:
    """The local fits at each point (n,), weighted by closeness over the nearest nodes."""
    low_mm, cell_mm = nodes_mm.min(axis=0), CELL * _node_pitch(nodes_mm, node_normals)
    cells = ((nodes_mm.max(axis=0) - low_mm) / cell_mm).astype(np.int64) + 1
    starts, order = counting_sort(cell_index(nodes_mm, low_mm, cell_mm, cells), int(cells.prod()))
    _, visit = counting_sort(cell_index(points_mm, low_mm, cell_mm, cells), int(cells.prod()))
    known = (nodes_mm, node_normals, fits, BLENDED, TURN_MM, order, starts, low_mm, cell_mm, cells)
    parts = over_parts(lambda a, b: blend(points_mm, normals, visit[a:b], *known), len(points_mm))
    values = np.empty(len(points_mm))
    values[visit] = np.concatenate(parts)
    return values


def _node_pitch(nodes_mm: Floats, normals: Floats) -> float:
    """How far most nodes have enough others to blend, and no less than fills a modest grid."""
    place = np.column_stack([nodes_mm, TURN_MM * normals])
    apart_mm, _ = _nearest(place, place, BLENDED)
    return max(float(np.median(apart_mm[:, -1])), float(np.ptp(nodes_mm, axis=0).max()) / 100.0, 1e-9)
