"""Local shape of a cloud: neighbours, normals, curvature."""

from dataclasses import dataclass

from geometry.errors import BadInput
from geometry.kernels import neighbours, quadric
from geometry.types import Floats, Ints


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LocalShape:
    """What the neighbourhood of each point says of the surface there; NaN where it says nothing."""

    neighbours: Ints  # (n, 16), balanced by direction; -1 where a sector is empty
    normals: Floats  # (n, 3), unit, of either sign
    gaussian_per_mm2: Floats  # (n,)
    mean_per_mm: Floats  # (n,), positive where the surface bends towards its normal
    offset_mm: Floats  # (n,) height of the fitted surface above the point, along the normal


def k_nearest(points_mm: Floats, k: int) -> tuple[Ints, Floats]:
    """Indices (n, k) and distances (n, k), mm, of the k nearest points of each point, itself first.

    Raises `BadInput` unless 1 <= k <= n.
    """
    if not 1 <= k <= len(points_mm):
        raise BadInput(f"{k} neighbours asked of {len(points_mm)} points")
    return neighbours.k_nearest(points_mm, k)


def local_shape(
    points_mm: Floats, *, candidates: int = 30, sectors: int = 8, per_sector: int = 2
) -> LocalShape:
    """The local quadric of each point over a neighbourhood balanced by direction.

    From the nearest `candidates`, the `per_sector` nearest of each of `sectors` sectors of the tangent
    plane are kept, so that dense scan lines do not outvote the rest; the quadric is the least-squares
    height field over that plane (thesis eq. 3.3), its Gaussian curvature that of eq. 3.4.
    Raises `BadInput` for fewer than seven points.
    """
    if len(points_mm) < 7:
        raise BadInput(f"{len(points_mm)} points do not determine a local quadric")
    nearest, _ = k_nearest(points_mm, min(candidates, len(points_mm)))
    balanced, normals, gaussian, mean, offset = quadric.balanced_quadrics(
        points_mm, nearest, sectors, per_sector
    )
    return LocalShape(
        neighbours=balanced,
        normals=normals,
        gaussian_per_mm2=gaussian,
        mean_per_mm=mean,
        offset_mm=offset,
    )
