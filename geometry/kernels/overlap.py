"""How far one view lies above the others at each point, and how an error of the axis changes that."""

import numpy as np
from numba import njit

from geometry.types import Floats, Ints


@njit(cache=True, nogil=True)
def heights_over_others(
    points: Floats, normals: Floats, angle_rad: Floats, view: Ints, nearest: Ints
) -> tuple[Floats, Floats, Floats, Ints]:
    """Height (n,), along each point's normal, of the mean of its neighbours (n, k) that its own view saw over
    the mean of those that other views saw; what an axis error (rx, ry, tx, ty) adds to it per unit (n, 4);
    how far the two means are apart (n,); and the smaller of the two numbers of neighbours (n,).

    The point itself takes no part: it would stand above the others wherever the surface bends. A point is
    x = Rz(-angle) q; the error takes q to q - r x q - t, which moves x along a normal n by
    -(r . (q x m) + t . m) with m = Rz(angle) n. Zero where either kind of neighbour is missing.
    """
    count, k = nearest.shape
    height, apart, felt, step = np.zeros(count), np.zeros(count), np.zeros((count, 4)), np.empty(3)
    fewer = np.zeros(count, np.int64)
    for i in range(count):
        own = 0
        for j in range(1, k):
            own += view[nearest[i, j]] == view[i]
        fewer[i] = min(own, k - 1 - own)
        if fewer[i] == 0:
            continue
        step[:] = 0.0
        for j in range(1, k):
            p = nearest[i, j]
            share = 1.0 / own if view[p] == view[i] else -1.0 / (k - 1 - own)
            c, s = np.cos(angle_rad[p]), np.sin(angle_rad[p])
            x, y, z = c * points[p, 0] - s * points[p, 1], s * points[p, 0] + c * points[p, 1], points[p, 2]
            u, v = c * normals[i, 0] - s * normals[i, 1], s * normals[i, 0] + c * normals[i, 1]
            w = normals[i, 2]
            felt[i, 0] -= share * (y * w - z * v)
            felt[i, 1] -= share * (z * u - x * w)
            felt[i, 2] -= share * u
            felt[i, 3] -= share * v
            step += share * points[p]
        height[i] = step @ normals[i]
        apart[i] = np.sqrt(step @ step)
    return height, felt, apart, fewer
