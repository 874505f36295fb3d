"""Which points of an aligned cloud lie on damage, told by the signed residuals of their neighbourhoods."""

from dataclasses import dataclass

import numpy as np

from geometry.errors import BadInput
from geometry.kernels.graph import dilate, grow, neighbourhood_mean
from geometry.types import Bools, Floats, Ints


@dataclass(frozen=True, slots=True, kw_only=True)
class MaskSettings:
    neighbours: int = 16
    high: float = 5.0  # of the scale: certainly damaged
    low: float = 2.5  # damaged if joined to what certainly is

    def __post_init__(self) -> None:
        if not (self.neighbours >= 4 and 0.0 < self.low <= self.high):
            raise BadInput(f"mask: {self} contradicts itself")


def robust_sigma(values: Floats) -> float:
    """Standard deviation of the values were they normal: 1.4826 of the median distance from the median."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def damaged(distance_mm: Floats, neighbours: Ints, floor_mm: float, settings: MaskSettings) -> Bools:
    """The points (n,) whose neighbourhood lies off the nominal, with one ring around them.

    `distance_mm` (n,) is signed, `neighbours` (n, k) of each point. The mean over a neighbourhood keeps what
    damage does and averages noise away; its robust scatter, but at least `floor_mm`, is the scale. From
    seeds beyond `high` scales the flag grows over the neighbour graph down to `low`.
    """
    smooth_mm = neighbourhood_mean(distance_mm, neighbours[:, 1:])
    scale_mm = max(robust_sigma(smooth_mm), floor_mm)
    size = np.abs(smooth_mm) / scale_mm
    return np.asarray(dilate(grow(size > settings.high, size > settings.low, neighbours), neighbours))
