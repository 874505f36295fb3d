"""Normals, sums and all-pairs searches on one closed section curve."""

import math

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
    What is farther from the contact than a circle is wide cannot bound it, nor can as many nodes after it as
    do not come that near.
    """
    radius = np.full(len(at), np.inf)
    contact = np.zeros(len(at), np.int64)
    step = 1e-300  # the longest between neighbours of `against`
    for k in range(1, len(against)):
        j, i = against[k], against[k - 1]
        dx, dy = points_mm[j, 0] - points_mm[i, 0], points_mm[j, 1] - points_mm[i, 1]
        step = max(step, math.sqrt(dx * dx + dy * dy))
    last = 0
    for n in range(len(at)):
        i = at[n]
        k = -1 if len(against) > 0 else 0  # first the contact of the circle before, which bounds well
        while k < len(against):
            j = against[k if k >= 0 else last]
            dx, dy = points_mm[j, 0] - points_mm[i, 0], points_mm[j, 1] - points_mm[i, 1]
            depth = -(dx * normals[i, 0] + dy * normals[i, 1])
            d2 = dx * dx + dy * dy
            if depth > 0.0 and d2 < 2.0 * depth * radius[n]:
                radius[n], contact[n] = d2 / (2.0 * depth), j
                last = k if k >= 0 else last
            beyond = math.sqrt(d2) - 2.0 * radius[n] if k >= 0 else 0.0
            k += 1 + int(max(0.0, beyond / step - 1e-6))
    return radius, contact


@njit(cache=True, nogil=True)
def closed_normals(curve_mm: Floats) -> Floats:
    """Unit outward normals (m, 2) of a closed counter-clockwise curve, from each node's neighbours."""
    m = len(curve_mm)
    out = np.empty((m, 2))
    for i in range(m):
        before, after = (i if i > 0 else m) - 1, i + 1 if i + 1 < m else 0
        x = curve_mm[after, 0] - curve_mm[before, 0]
        y = curve_mm[after, 1] - curve_mm[before, 1]
        length = math.sqrt(x * x + y * y)
        out[i, 0], out[i, 1] = y / length, -x / length
    return out


@njit(cache=True, nogil=True)
def closed_steps(curve_mm: Floats) -> Floats:
    """Length (m,) from each node of a closed curve to the next."""
    m = len(curve_mm)
    out = np.empty(m)
    for i in range(m):
        after = i + 1 if i + 1 < m else 0
        x, y = curve_mm[after, 0] - curve_mm[i, 0], curve_mm[after, 1] - curve_mm[i, 1]
        out[i] = math.sqrt(x * x + y * y)
    return out


@njit(cache=True, nogil=True)
def area_moments(curve_mm: Floats) -> tuple[float, float, float]:
    """Area of a closed counter-clockwise polygon and its first moments x, y, all about node 0."""
    area = x = y = 0.0
    ox, oy = curve_mm[0]
    for i in range(1, len(curve_mm) - 1):
        ax, ay = curve_mm[i, 0] - ox, curve_mm[i, 1] - oy
        bx, by = curve_mm[i + 1, 0] - ox, curve_mm[i + 1, 1] - oy
        cross = ax * by - bx * ay
        area += 0.5 * cross
        x += cross * (ax + bx) / 6.0
        y += cross * (ay + by) / 6.0
    return area, x, y
