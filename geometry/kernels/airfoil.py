"""All-pairs searches on one closed section curve."""

import numpy as np
from numba import njit

from geometry.types import Floats, Ints


@njit(cache=True, nogil=True)
def farthest_pair(points_mm: Floats, first: Ints, second: Ints) -> tuple[int, int]:
    """The indices, one of `first` and one of `second`, of the two points farthest apart."""
    best = -1.0
    a = b = 0
    for i in first:
        for j in second:
            d2 = (points_mm[i, 0] - points_mm[j, 0]) ** 2 + (points_mm[i, 1] - points_mm[j, 1]) ** 2
            if d2 > best:
                best, a, b = d2, i, j
    return a, b


@njit(cache=True, nogil=True)
def inscribed_circles(points_mm: Floats, normals: Floats, at: Ints, against: Ints) -> tuple[Floats, Ints]:
    """Radius of the largest circle inside that touches the curve in each node of `at`, and its other contact.

    `normals` (m, 2) point outward. Only nodes of `against` bound the circles: the other side of the
    airfoil, so that ripples beside the contact do not shrink them. Radius inf where nothing bounds it.
    """
    radius = np.full(len(at), np.inf)
    contact = np.zeros(len(at), np.int64)
    for n in range(len(at)):
        i = at[n]
        for j in against:
            dx = points_mm[j, 0] - points_mm[i, 0]
            dy = points_mm[j, 1] - points_mm[i, 1]
            depth = -(dx * normals[i, 0] + dy * normals[i, 1])
            if depth > 0.0:
                r = (dx * dx + dy * dy) / (2.0 * depth)
                if r < radius[n]:
                    radius[n], contact[n] = r, j
    return radius, contact
