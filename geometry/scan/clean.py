"""Points that are no surface taken out of a cloud, and too many points made fewer."""

from dataclasses import dataclass

import numpy as np

from geometry.errors import BadInput
from geometry.kernels.graph import component_sizes
from geometry.kernels.neighbours import cell_keys, sorted_nearest
from geometry.kernels.parts import over_parts
from geometry.kernels.quadric import plane_heights
from geometry.scan.neighbourhood import Neighboured
from geometry.types import Bools, Cloud, Floats, Ints

STEPS = 30
FULL = 0.96  # of the points that may be kept: enough to stop seeking a finer grid


@dataclass(frozen=True, slots=True, kw_only=True)
class CleanSettings:
    neighbours: int = 12
    kept_neighbours: int = 16  # that later steps find with the cloud
    sparse_ratio: float = 6.0  # of the median distance to neighbours: farther points are not joined
    outlier_sigmas: float = 6.0  # height over the neighbours' plane, in their own scatter and in sigma
    smallest_cluster: int = 30  # points; fewer, apart from everything else, are no surface
    most_points: int = 1_000_000

    def __post_init__(self) -> None:
        if not 6 <= self.neighbours <= self.kept_neighbours:
            raise BadInput(f"clean: {self} asks for too few neighbours")
        if self.most_points < 1 or self.smallest_cluster < 1:
            raise BadInput(f"clean: {self} asks for too few points")
        if not (self.sparse_ratio > 1.0 and self.outlier_sigmas > 0.0):
            raise BadInput(f"clean: {self} would take the surface itself")


def clean(cloud: Cloud, settings: CleanSettings = CleanSettings()) -> Cloud:
    """The measured points that lie on a surface, thinned to at most `most_points`, none moved,
    in an order that keeps neighbours together: every later step walks the cloud faster so.

    Flying pixels and isolated clusters go first, then points off the plane of their neighbours where these
    agree among themselves: at an edge they do not, so edges stay. A cloud too small to judge is returned
    as it is.
    """
    if len(cloud) <= 2 * settings.kept_neighbours:
        return cloud
    stays = len(cloud) <= settings.most_points
    wanted = settings.kept_neighbours if stays else settings.neighbours  # thinning would part the others
    order, nearest, distance_mm = sorted_nearest(cloud.points_mm, wanted + 1)
    cloud = cloud.of(order)
    strays = _strays(nearest, distance_mm, settings)
    return _thin(_without(cloud, strays | _outliers(cloud, nearest, settings), nearest), settings.most_points)


def _without(cloud: Cloud, gone: Bools, nearest: Ints) -> Neighboured:
    """The cloud without the points that are gone, and the neighbours of the rest."""
    if gone.any():
        place = np.where(gone, -1, np.cumsum(~gone) - 1)
        cloud, nearest = cloud.of(~gone), place[nearest[~gone]]
    return Neighboured(points_mm=cloud.points_mm, sigma_mm=cloud.sigma_mm, view=cloud.view, nearest=nearest)


def _strays(nearest: Ints, distance_mm: Floats, settings: CleanSettings) -> Bools:
    """Small groups of points, and single ones, that are no near neighbours of the rest.

    Two points are joined if each is among the nearest of the other: a flying pixel has neighbours on the
    surface, but these have nearer ones of their own.
    """
    width = settings.neighbours + 1
    reach_mm = settings.sparse_ratio * float(np.median(distance_mm[:, 1:width].mean(axis=1)))
    return component_sizes(nearest, distance_mm, width, reach_mm) < settings.smallest_cluster


def _outliers(cloud: Cloud, nearest: Ints, settings: CleanSettings) -> Bools:
    """Points off the plane of neighbours that agree among themselves."""
    width = settings.neighbours + 1
    parts = over_parts(lambda a, b: plane_heights(cloud.points_mm, nearest, width, a, b), len(cloud))
    height_mm, scatter_mm = (np.concatenate(of_parts) for of_parts in zip(*parts, strict=True))
    limit_mm = settings.outlier_sigmas * np.maximum(scatter_mm, cloud.sigma_mm)
    return np.asarray(np.abs(height_mm) > limit_mm)


def _thin(cloud: Cloud, most_points: int) -> Cloud:
    """At most `most_points` of the points: of each cell of a grid, the one nearest to the cell's middle."""
    if len(cloud) <= most_points:
        return cloud
    low_mm, high_mm = cloud.points_mm.min(axis=0), cloud.points_mm.max(axis=0)
    widest_mm = float((high_mm - low_mm).max()) + 1e-9
    finest_mm, cell_mm = widest_mm, widest_mm / np.sqrt(most_points)
    for _ in range(STEPS):
        count = int(np.count_nonzero(_firsts(np.sort(cell_keys(cloud.points_mm, low_mm, cell_mm)))))
        if count <= most_points:
            finest_mm = min(finest_mm, cell_mm)
        if FULL * most_points <= count <= most_points:
            break
        cell_mm *= np.sqrt(2.0 * count / ((1.0 + FULL) * most_points))  # cells on a surface go by its area
    return cloud.of(_nearest_to_middle(cloud.points_mm, low_mm, finest_mm))


def _firsts(ascending: Ints) -> Bools:
    """Where in a sorted array (n,) another value begins."""
    return np.concatenate([[True], np.diff(ascending) != 0])


def _nearest_to_middle(points_mm: Floats, low_mm: Floats, cell_mm: float) -> Ints:
    keys = cell_keys(points_mm, low_mm, cell_mm)
    order = np.argsort(keys, kind="stable")
    within = (points_mm[order] - low_mm) / cell_mm
    off = np.linalg.norm(within - np.floor(within) - 0.5, axis=1)
    firsts = _firsts(keys[order])
    cell = np.cumsum(firsts) - 1
    least = np.flatnonzero(off == np.minimum.reduceat(off, np.flatnonzero(firsts))[cell])
    return np.sort(order[least[_firsts(cell[least])]])
