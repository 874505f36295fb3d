"""Signed distance to a scanned surface, blended from a local quadric at every point."""

import numpy as np
from numba import njit

from geometry.types import Floats

WIDENING = 0.7  # of a blend of quadrics, per distance from the nearest point


@njit(cache=True, nogil=True)
def nearest_points(
    shape: tuple[int, int, int], origin_mm: Floats, step_mm: float, points_mm: Floats, reach_mm: float
) -> Floats:
    """Distance (mm) of each node of a grid, of `shape`, to the nearest point; infinity beyond `reach_mm`."""
    nearest2 = np.full(shape, np.inf)
    r = reach_mm / step_mm
    for p in range(len(points_mm)):
        x0 = (points_mm[p, 0] - origin_mm[0]) / step_mm
        y0 = (points_mm[p, 1] - origin_mm[1]) / step_mm
        z0 = (points_mm[p, 2] - origin_mm[2]) / step_mm
        for i in range(max(0, int(np.ceil(x0 - r))), min(shape[0], int(np.floor(x0 + r)) + 1)):
            dx2 = (i - x0) * (i - x0)
            for j in range(max(0, int(np.ceil(y0 - r))), min(shape[1], int(np.floor(y0 + r)) + 1)):
                rest2 = r * r - dx2 - (j - y0) * (j - y0)
                if rest2 < 0.0:
                    continue
                rz = np.sqrt(rest2)
                for k in range(max(0, int(np.ceil(z0 - rz))), min(shape[2], int(np.floor(z0 + rz)) + 1)):
                    d2 = r * r - rest2 + (k - z0) * (k - z0)
                    nearest2[i, j, k] = min(nearest2[i, j, k], d2)
    return step_mm * np.sqrt(nearest2)


@njit(cache=True, nogil=True)
def blend_quadrics(
    nearest_mm: Floats,
    origin_mm: Floats,
    step_mm: float,
    points_mm: Floats,
    frames: Floats,
    bending: Floats,
    width_mm: Floats,
    reach_mm: float,
    widening: float,
) -> Floats:
    """Signed distance (mm) at the nodes of a grid whose distances to the nearest point are `nearest_mm`.

    Implicit moving least squares (Kolluri, 2008): f(x) = sum w_i q_i(x) / sum w_i with the weights
    w_i = width_i^2 exp(-(|x - p_i|^2 - d^2) / (width_i^2 + (widening (d - width_i)+)^2)), d the distance of
    the nearest point: in a hole between the points all those at its border speak, not the nearest alone. q_i
    is the height of x above the quadric of point i: `frames` (n, 3, 3) holds its two tangents and its normal
    as rows, `bending` (n, 3) the second derivatives uu, uv, vv. Planes alone would shift a surface of radius
    R by width^2 / 2R. Where `nearest_mm` is infinite, so is the distance; no point speaks beyond `reach_mm`.
    """
    shape = nearest_mm.shape
    weighted = np.zeros(shape)
    weight = np.zeros(shape)
    reach2 = reach_mm * reach_mm
    for p in range(len(points_mm)):
        width2 = width_mm[p] * width_mm[p]
        bent2 = bending[p, 0] ** 2 + 2.0 * bending[p, 1] ** 2 + bending[p, 2] ** 2
        x0 = (points_mm[p, 0] - origin_mm[0]) / step_mm
        y0 = (points_mm[p, 1] - origin_mm[1]) / step_mm
        z0 = (points_mm[p, 2] - origin_mm[2]) / step_mm
        r = reach_mm / step_mm
        for i in range(max(0, int(np.ceil(x0 - r))), min(shape[0], int(np.floor(x0 + r)) + 1)):
            dx = (i - x0) * step_mm
            for j in range(max(0, int(np.ceil(y0 - r))), min(shape[1], int(np.floor(y0 + r)) + 1)):
                dy = (j - y0) * step_mm
                rest2 = reach2 - dx * dx - dy * dy
                if rest2 < 0.0:
                    continue
                rz = np.sqrt(rest2) / step_mm
                for k in range(max(0, int(np.ceil(z0 - rz))), min(shape[2], int(np.floor(z0 + rz)) + 1)):
                    dz = (k - z0) * step_mm
                    near = nearest_mm[i, j, k]
                    if near == np.inf:
                        continue
                    wider = widening * max(near - width_mm[p], 0.0)
                    exponent = (dx * dx + dy * dy + dz * dz - near * near) / (width2 + wider * wider)
                    if exponent > 12.0:
                        continue
                    u = dx * frames[p, 0, 0] + dy * frames[p, 0, 1] + dz * frames[p, 0, 2]
                    v = dx * frames[p, 1, 0] + dy * frames[p, 1, 1] + dz * frames[p, 1, 2]
                    n = dx * frames[p, 2, 0] + dy * frames[p, 2, 1] + dz * frames[p, 2, 2]
                    sag = 0.5 * (bending[p, 0] * u * u + 2.0 * bending[p, 1] * u * v + bending[p, 2] * v * v)
                    far2 = (u * u + v * v) / (2.25 * width2)
                    if far2 > 1.0:  # a quadric is not to be trusted far beyond the points that made it
                        sag /= far2
                    if sag * sag * bent2 > 1.0:  # nor does a round fall by more than its radius
                        sag = np.copysign(1.0 / np.sqrt(bent2), sag)
                    w = width2 * np.exp(-exponent)
                    weighted[i, j, k] += w * (n - sag)
                    weight[i, j, k] += w
    signed = np.full(shape, np.inf)
    for i in range(shape[0]):
        for j in range(shape[1]):
            for k in range(shape[2]):
                if weight[i, j, k] > 0.0:
                    signed[i, j, k] = weighted[i, j, k] / weight[i, j, k]
    return signed
