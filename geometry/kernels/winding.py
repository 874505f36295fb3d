"""How far a surface, given by points that stand for parts of it, winds round other places."""

import numpy as np
from numba import njit

from geometry.types import Floats


@njit(cache=True, nogil=True)
def winding_numbers(places_mm: Floats, points_mm: Floats, areas_mm2: Floats) -> Floats:
    """Winding number (n,) of the surface about places (n, 3): 1 inside a closed one, 0 outside.

    Each point (k, 3) stands for a part of the surface; `areas_mm2` (k, 3) is its area along its outward
    normal. Sum of the solid angles of the parts over 4 pi (Barill et al., 2018, eq. 4).
    """
    found = np.zeros(len(places_mm))
    for i in range(len(places_mm)):
        total = 0.0
        for j in range(len(points_mm)):
            x = points_mm[j, 0] - places_mm[i, 0]
            y = points_mm[j, 1] - places_mm[i, 1]
            z = points_mm[j, 2] - places_mm[i, 2]
            square = x * x + y * y + z * z
            if square > 0.0:
                through = x * areas_mm2[j, 0] + y * areas_mm2[j, 1] + z * areas_mm2[j, 2]
                total += through / (square * np.sqrt(square))
        found[i] = total / (4.0 * np.pi)
    return found
