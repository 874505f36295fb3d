"""Signed distance to a scanned surface, blended from a local quadric at every point."""

import numpy as np
from numba import njit

from geometry.types import Floats


@njit(cache=True, nogil=True)
def blend_quadrics(
    shape: tuple[int, int, int],
    origin_mm: Floats,
    step_mm: float,
    points_mm: Floats,
    frames: Floats,
    bending: Floats,
    width_mm: Floats,
    reach_mm: float,
) -> tuple[Floats, Floats]:
    """Signed distance and distance to the nearest point (mm) at the nodes of a grid, each of `shape`.

    Implicit moving least squares (Kolluri, 2008): f(x) = sum w_i q_i(x) / sum w_i with the weights
    w_i = width_i^2 exp(-|x - p_i|^2 / width_i^2), where q_i is the height of x above the quadric of point i:
    `frames` (n, 3, 3) holds its two tangents and its normal as rows, `bending` (n, 3) the second derivatives
    uu, uv, vv. Planes alone would shift a surface of radius R by width^2 / 2R. Nodes farther than `reach_mm`
    from every point get infinity in both.
    """
    weighted = np.zeros(shape)
    weight = np.zeros(shape)
    nearest2 = np.full(shape, np.inf)
    reach2 = reach_mm * reach_mm
    for p in range(len(points_mm)):
        width2 = width_mm[p] * width_mm[p]
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
                    d2 = dx * dx + dy * dy + dz * dz
                    u = dx * frames[p, 0, 0] + dy * frames[p, 0, 1] + dz * frames[p, 0, 2]
                    v = dx * frames[p, 1, 0] + dy * frames[p, 1, 1] + dz * frames[p, 1, 2]
                    n = dx * frames[p, 2, 0] + dy * frames[p, 2, 1] + dz * frames[p, 2, 2]
                    sag = 0.5 * (bending[p, 0] * u * u + 2.0 * bending[p, 1] * u * v + bending[p, 2] * v * v)
                    far2 = (u * u + v * v) / (2.25 * width2)
                    if far2 > 1.0:  # a quadric is not to be trusted far beyond the points that made it
                        sag /= far2
                    w = width2 * np.exp(-d2 / width2)
                    weighted[i, j, k] += w * (n - sag)
                    weight[i, j, k] += w
                    nearest2[i, j, k] = min(nearest2[i, j, k], d2)
    signed = np.full(shape, np.inf)
    for i in range(shape[0]):
        for j in range(shape[1]):
            for k in range(shape[2]):
                if weight[i, j, k] > 0.0:
                    signed[i, j, k] = weighted[i, j, k] / weight[i, j, k]
    return signed, np.sqrt(nearest2)
