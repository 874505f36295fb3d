"""A cloud that brings the nearest neighbours of its points along, so that no later step searches again."""

from dataclasses import dataclass

from geometry.errors import BadInput
from geometry.kernels.neighbours import k_nearest
from geometry.types import Cloud, Ints


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
