"""Damage by region growing on distance and direction together (thesis 5.4.2)."""

from dataclasses import dataclass

import numpy as np

from geometry.blade.nominal import Closest, Nominal
from geometry.errors import BadInput
from geometry.kernels.graph import grow
from geometry.scan.surface import local_shape
from geometry.thesis.fine_tuned import min_max
from geometry.types import Bools, Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class RegionGrowingSettings:
    """`threshold` is the thesis' thr: of the geometric error, 0 to 2, found by trial.

    A region's first point stands out by `seed` and lies `least_mm` off the nominal. The thesis has no such
    point to pass: it starts where the error is largest, which on a sound blade is noise.
    """

    threshold: float = 0.12
    seed: float = 0.6
    least_mm: float = 0.2

    def __post_init__(self) -> None:
        if not 0.0 < self.threshold <= self.seed <= 2.0:
            raise BadInput(f"region growing: {self} contradicts itself")
        if not self.least_mm > 0.0:
            raise BadInput(f"region growing: least_mm = {self.least_mm} is not a distance")


def grow_damage(scan_mm: Floats, nominal: Nominal, settings: RegionGrowingSettings) -> Bools:
    """The points (n,) of an aligned scan that lie in damaged regions.

    Each region grows from its point of largest error over balanced neighbourhoods to where the error falls to
    the threshold. The thesis picks the next point by size, which changes the order and not the region.
    """
    shape, found = local_shape(scan_mm), nominal.closest(scan_mm)
    error = geometric_error(shape.normals, found)
    begins = (error > settings.seed) & (np.abs(found.distance_mm) > settings.least_mm)
    return grow(begins, error > settings.threshold, shape.neighbours)


def geometric_error(scan_normals: Floats, found: Closest) -> Floats:
    """Distance plus turn of the normal (n,), each brought to 0..1 over the scan (eq. 5.1, 5.2).

    The CAD point of each scan point is its foot on the exact nominal, the limit of dense sampling; a normal
    of the scan has no sign, so turns go to 90 degrees. A point without a normal counts by distance alone.
    """
    cosine = np.abs(np.einsum("nj,nj->n", scan_normals, found.normals))
    turn = np.arccos(np.clip(np.nan_to_num(cosine, nan=1.0), 0.0, 1.0))
    return min_max(np.abs(found.distance_mm)) + min_max(turn)
