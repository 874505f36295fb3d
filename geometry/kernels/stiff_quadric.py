"""Local quadrics of a cloud whose normals are known about, and the points of them nearest to other points."""

import numpy as np
from numba import njit

from geometry.types import Floats, Ints

TERMS = 6  # of the height field c + gx u + gy v + a u^2 + b uv + d v^2
RIDGE = 1e-9  # of the neighbours' count: where they do not tell all terms the rest stay near zero
FOOT_STEPS = 8
BEYOND = 0.6  # reaches: farther from its point a quadric says nothing


@njit(cache=True, nogil=True)
def fit_quadrics(
    points: Floats, normals: Floats, candidates: Ints, sectors: int, per_sector: int
) -> tuple[Floats, Floats, Floats]:
    """Frames (n, 3, 3), coefficients (n, 6) and reach (n,) of the quadric through each point's surroundings.

    The frame's rows are two tangents and the given normal. Of the `candidates` (n, k; nearest first, -1
    none) the `per_sector` nearest of each sector of the tangent plane are taken, with the point itself, and
    the height above it is fitted by least squares. Coordinates are in units of `reach`, the distance of the
    farthest neighbour taken; reach 0 where fewer than six neighbours are: such a point has no quadric.
    """
    count, width = candidates.shape
    frames, coefficients = np.empty((count, 3, 3)), np.zeros((count, TERMS))
    reach = np.zeros(count)
    taken, row = np.empty(sectors, np.int64), np.empty(TERMS)
    local = np.empty((width, 3))
    for i in range(count):
        _frame(normals[i], frames[i])
        taken[:], found, far = 0, 0, 0.0
        for j in range(width):
            q = candidates[i, j]
            if q < 0 or q == i:
                continue
            u, v, w = _to_local(points[q], points[i], frames[i])
            sector = int((np.arctan2(v, u) + np.pi) / (2.0 * np.pi) * sectors) % sectors
            if taken[sector] < per_sector:
                taken[sector] += 1
                local[found, 0], local[found, 1], local[found, 2] = u, v, w
                far = max(far, u * u + v * v)
                found += 1
        if found < TERMS:
            continue
        reach[i] = np.sqrt(far)
        design, right = RIDGE * found * np.eye(TERMS), np.zeros(TERMS)
        design[0, 0] += 1.0
        for s in range(found):
            u, v, w = local[s] / reach[i]
            row[0], row[1], row[2], row[3], row[4], row[5] = 1.0, u, v, u * u, u * v, v * v
            for a in range(TERMS):
                right[a] += row[a] * w
                for b in range(TERMS):
                    design[a, b] += row[a] * row[b]
        coefficients[i] = np.linalg.solve(design, right)
    return frames, coefficients, reach


@njit(cache=True, nogil=True)
def feet_on_quadrics(
    targets: Floats, owner: Ints, points: Floats, frames: Floats, coefficients: Floats, reach: Floats
) -> Floats:
    """The point (m, 3) nearest to each target (m, 3) on the quadric of its owner (m,), in mm.

    Gauss-Newton on the squared distance. NaN where the owner has no quadric.
    """
    feet = np.full(targets.shape, np.nan)
    for k in range(len(targets)):
        i = owner[k]
        if reach[i] == 0.0:
            continue
        a, b, c = _to_local(targets[k], points[i], frames[i])
        a, b, c = a / reach[i], b / reach[i], c / reach[i]
        g = coefficients[i]
        u, v = a, b
        for _ in range(FOOT_STEPS):
            height = g[0] + g[1] * u + g[2] * v + g[3] * u * u + g[4] * u * v + g[5] * v * v
            hu, hv = g[1] + 2.0 * g[3] * u + g[4] * v, g[2] + g[4] * u + 2.0 * g[5] * v
            ru, rv = u - a + (height - c) * hu, v - b + (height - c) * hv
            uu, uv, vv = 1.0 + hu * hu, hu * hv, 1.0 + hv * hv
            det = uu * vv - uv * uv
            u, v = u - (vv * ru - uv * rv) / det, v - (uu * rv - uv * ru) / det
        if u * u + v * v > BEYOND * BEYOND:
            continue
        w = g[0] + g[1] * u + g[2] * v + g[3] * u * u + g[4] * u * v + g[5] * v * v
        for axis in range(3):
            aside = u * frames[i, 0, axis] + v * frames[i, 1, axis] + w * frames[i, 2, axis]
            feet[k, axis] = points[i, axis] + reach[i] * aside
    return feet


@njit(cache=True, nogil=True, inline="always")
def _to_local(point, origin, frame):  # type: ignore[no-untyped-def]
    x, y, z = point[0] - origin[0], point[1] - origin[1], point[2] - origin[2]
    return (
        x * frame[0, 0] + y * frame[0, 1] + z * frame[0, 2],
        x * frame[1, 0] + y * frame[1, 1] + z * frame[1, 2],
        x * frame[2, 0] + y * frame[2, 1] + z * frame[2, 2],
    )


@njit(cache=True, nogil=True, inline="always")
def _frame(normal, frame):  # type: ignore[no-untyped-def]
    """Fill `frame` with two tangents and the normal, rows."""
    x, y, z = normal[0], normal[1], normal[2]
    ux, uy, uz = (1.0 - x * x, -x * y, -x * z) if abs(x) < 0.6 else (-y * x, 1.0 - y * y, -y * z)
    length = np.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux / length, uy / length, uz / length
    frame[0, 0], frame[0, 1], frame[0, 2] = ux, uy, uz
    frame[1, 0], frame[1, 1], frame[1, 2] = y * uz - z * uy, z * ux - x * uz, x * uy - y * ux
    frame[2, 0], frame[2, 1], frame[2, 2] = x, y, z
