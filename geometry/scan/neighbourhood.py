"""Points and their neighbours: a cloud that brings the nearest along, so that no later step searches again;
how much surface each point stands for, and which lie next to others."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from geometry.errors import BadInput
from geometry.kernels.graph import neighbourhood_mean
from geometry.kernels.neighbours import k_nearest
from geometry.types import Bools, Cloud, Floats, Ints

MOST_UNEVEN = 8.0  # a point stands for at most so many times the usual surface, and at least for that part


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Neighboured(Cloud):
    """A cloud and the nearest neighbours of each of its points.

    `nearest` (n, k): indices, the point itself first, then by distance; -1 where a neighbour was taken out
    of the cloud since.
    """

    nearest: Ints

    def __post_init__(self) -> None:
        Cloud.__post_init__(self)
        if self.nearest.ndim != 2 or len(self.nearest) != len(self.points_mm):
            raise BadInput(f"cloud: {len(self)} points, neighbours of shape {self.nearest.shape}")


def nearest_of(cloud: Cloud, k: int) -> Ints:
    """Indices (n, k) of the k nearest points of each point, itself first; -1 as in `Neighboured`.

    Raises `ValueError` unless 1 <= k <= n.
    """
    if isinstance(cloud, Neighboured) and cloud.nearest.shape[1] == k:
        return cloud.nearest
    nearest, _ = k_nearest(cloud.points_mm, k)
    return nearest


def surface_shares(points_mm: Floats, nearest: Ints) -> Floats:
    """How much surface each point (n,) stands for, 1 in the mean: where views overlap, each for less.

    The square of the distance to the j-th of the `nearest` (n, k) grows as j times the surface that a point
    has; neighbours share what they tell.
    """
    squares_mm2, ranks = np.zeros(len(points_mm)), np.zeros(len(points_mm))
    for rank, other in enumerate(nearest.T[1:], 1):
        there = other >= 0
        squares_mm2 += there * ((points_mm[other] - points_mm) ** 2).sum(axis=1)
        ranks += there * rank
    some = ranks > 0.0
    if not some.any():
        return np.ones(len(points_mm))
    share = np.where(some, squares_mm2 / np.maximum(ranks, 1.0), 0.0)
    share[~some] = np.median(share[some])
    even = neighbourhood_mean(share, nearest[:, 1:])
    usual = max(float(np.median(even)), 1e-12)
    even = np.clip(even / usual, 1.0 / MOST_UNEVEN, MOST_UNEVEN)
    return np.asarray(even / even.mean())


def next_to(places: Floats, off: Bools, reach: float) -> Bools:
    """Which of the places (n, d) lie within reach of one that is off (n,)."""
    if not off.any():
        return off
    apart, _ = cKDTree(places[off]).query(places, distance_upper_bound=np.nextafter(reach, np.inf))
    return np.asarray(np.isfinite(apart))
