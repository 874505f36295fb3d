"""How far apart the neighbourhoods of corresponding points are."""

import numpy as np
from numba import njit

from geometry.types import Floats, Ints


@njit(cache=True, nogil=True)
def average_hausdorff(
    points: Floats,
    values: Floats,
    neighbours: Ints,
    other_points: Floats,
    other_values: Floats,
    other_neighbours: Ints,
    partner: Ints,
) -> tuple[Floats, Floats]:
    """Average Hausdorff distances (n,), Euclidean and of the values, between the neighbourhoods of partners.

    `partner` (n,) is the point of the other set that each point corresponds to; `neighbours` (n, k; -1 none)
    and `other_neighbours` (m, l; -1 none) index into their own sets. A neighbour whose value is not finite
    takes no part in the distance of values; NaN where a neighbourhood has no neighbour left.
    """
    count, width, other_width = len(points), neighbours.shape[1], other_neighbours.shape[1]
    euclidean, valued = np.empty(count), np.empty(count)
    back, back_value = np.empty(other_width), np.empty(other_width)
    for i in range(count):
        j = partner[i]
        back[:], back_value[:] = np.inf, np.inf
        total, members, value_total, value_members = 0.0, 0, 0.0, 0
        for s in range(width):
            a = neighbours[i, s]
            if a < 0:
                continue
            nearest2, nearest_value = np.inf, np.inf
            for t in range(other_width):
                b = other_neighbours[j, t]
                if b < 0:
                    continue
                d2 = 0.0
                for axis in range(3):
                    d = points[a, axis] - other_points[b, axis]
                    d2 += d * d
                nearest2, back[t] = min(nearest2, d2), min(back[t], d2)
                d = abs(values[a] - other_values[b])
                if np.isfinite(d):
                    nearest_value, back_value[t] = min(nearest_value, d), min(back_value[t], d)
            if nearest2 < np.inf:
                total, members = total + np.sqrt(nearest2), members + 1
            if nearest_value < np.inf:
                value_total, value_members = value_total + nearest_value, value_members + 1
        for t in range(other_width):
            if back[t] < np.inf:
                total, members = total + np.sqrt(back[t]), members + 1
            if back_value[t] < np.inf:
                value_total, value_members = value_total + back_value[t], value_members + 1
        euclidean[i] = total / members if members else np.nan
        valued[i] = value_total / value_members if value_members else np.nan
    return euclidean, valued
