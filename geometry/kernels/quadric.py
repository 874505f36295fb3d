"""Balanced neighbourhoods and local quadrics of a cloud."""

import numpy as np
from numba import njit

from geometry.types import Floats, Ints

PLANE_POINTS = 16  # the tangent plane that the sectors are drawn in comes from this many


@njit(cache=True, nogil=True)
def balanced_quadrics(
    points: Floats, nearest: Ints, sectors: int, per_sector: int
) -> tuple[Ints, Floats, Floats, Floats, Floats]:
    """Balanced neighbours (n, sectors * per_sector; -1 where a sector is empty) and their local quadric.

    The quadric z = c + gx u + gy v + a u^2 + b u v + d v^2 over the tangent plane is fitted by least squares
    to the point and its balanced neighbours. Returned with the neighbours: unit normals (n, 3) of either
    sign, Gaussian and mean curvatures (n,), and `offset` (n,), the quadric's height above the point.
    NaN where the neighbours do not determine a quadric.
    """
    count, candidates = nearest.shape
    neighbours = np.full((count, sectors * per_sector), -1, np.int64)
    normals = np.empty((count, 3))
    gaussian, mean, offset = np.empty(count), np.empty(count), np.empty(count)
    frame, design, right, row = np.empty((3, 3)), np.empty((6, 6)), np.empty(6), np.empty(6)
    taken = np.empty(sectors, np.int64)
    for i in range(count):
        _tangent_frame(points, nearest[i, : min(candidates, PLANE_POINTS)], frame)
        scale = 1e-12
        for axis in range(3):
            d = points[nearest[i, candidates - 1], axis] - points[i, axis]
            scale += d * d
        scale = np.sqrt(scale)
        design[:], right[:], taken[:], found = 0.0, 0.0, 0, 0
        design[0, 0] = 1.0
        for j in range(1, candidates):
            q = nearest[i, j]
            u, v, w = _local(points[q], points[i], frame, scale)
            sector = int((np.arctan2(v, u) + np.pi) / (2.0 * np.pi) * sectors) % sectors
            if taken[sector] == per_sector:
                continue
            taken[sector] += 1
            neighbours[i, found] = q
            found += 1
            row[0], row[1], row[2], row[3], row[4], row[5] = 1.0, u, v, u * u, u * v, v * v
            for a in range(6):
                right[a] += row[a] * w
                for b in range(a + 1):
                    design[a, b] += row[a] * row[b]
        solved = found >= 5 and cholesky_solve(design, right)
        if not solved:
            right[:] = np.nan
        gx, gy = right[1], right[2]
        fxx, fxy, fyy = 2.0 * right[3] / scale, right[4] / scale, 2.0 * right[5] / scale
        g2 = 1.0 + gx * gx + gy * gy
        gaussian[i] = (fxx * fyy - fxy * fxy) / (g2 * g2)
        mean[i] = ((1.0 + gy * gy) * fxx - 2.0 * gx * gy * fxy + (1.0 + gx * gx) * fyy) / (2.0 * g2**1.5)
        offset[i] = right[0] * scale
        for axis in range(3):
            normals[i, axis] = (frame[2, axis] - gx * frame[0, axis] - gy * frame[1, axis]) / np.sqrt(g2)
    return neighbours, normals, gaussian, mean, offset


@njit(cache=True, nogil=True, inline="always")
def _local(point, origin, frame, scale):  # type: ignore[no-untyped-def]
    x, y, z = point[0] - origin[0], point[1] - origin[1], point[2] - origin[2]
    u = (x * frame[0, 0] + y * frame[0, 1] + z * frame[0, 2]) / scale
    v = (x * frame[1, 0] + y * frame[1, 1] + z * frame[1, 2]) / scale
    w = (x * frame[2, 0] + y * frame[2, 1] + z * frame[2, 2]) / scale
    return u, v, w


@njit(cache=True, nogil=True)
def _tangent_frame(points: Floats, near: Ints, frame: Floats) -> tuple[float, float, float]:
    """Mean of the points `near`; the rows of `frame` become two tangents and the normal of their plane."""
    mx, my, mz = 0.0, 0.0, 0.0
    for q in near:
        mx += points[q, 0]
        my += points[q, 1]
        mz += points[q, 2]
    mx, my, mz = mx / len(near), my / len(near), mz / len(near)
    xx, yy, zz, xy, yz, xz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for q in near:
        x, y, z = points[q, 0] - mx, points[q, 1] - my, points[q, 2] - mz
        xx, yy, zz = xx + x * x, yy + y * y, zz + z * z
        xy, yz, xz = xy + x * y, yz + y * z, xz + x * z
    nx, ny, nz = _least_axis(xx, yy, zz, xy, yz, xz)
    # A tangent: the coordinate axis across the normal, less its part along it.
    ux, uy, uz = (1.0 - nx * nx, -nx * ny, -nx * nz) if abs(nx) < 0.6 else (-ny * nx, 1.0 - ny * ny, -ny * nz)
    length = np.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux / length, uy / length, uz / length
    frame[0, 0], frame[0, 1], frame[0, 2] = ux, uy, uz
    frame[1, 0], frame[1, 1], frame[1, 2] = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
    frame[2, 0], frame[2, 1], frame[2, 2] = nx, ny, nz
    return mx, my, mz


@njit(cache=True, nogil=True, inline="always")
def _least_axis(xx, yy, zz, xy, yz, xz):  # type: ignore[no-untyped-def]
    """Unit eigenvector of the smallest eigenvalue of a symmetric 3x3; z where the matrix is isotropic.

    Eigenvalue in closed form (Smith, 1961), vector the largest cross product of two rows of c - lambda I.
    """
    q = (xx + yy + zz) / 3.0
    off = xy * xy + yz * yz + xz * xz
    p = np.sqrt(((xx - q) ** 2 + (yy - q) ** 2 + (zz - q) ** 2 + 2.0 * off) / 6.0)
    if not p > 1e-12 * abs(q):
        return 0.0, 0.0, 1.0
    a, b, d, e, f, g = (xx - q) / p, (yy - q) / p, (zz - q) / p, xy / p, yz / p, xz / p
    half = (a * (b * d - f * f) - e * (e * d - f * g) + g * (e * f - b * g)) / 2.0
    lowest = 2.0 * np.cos(np.arccos(min(max(half, -1.0), 1.0)) / 3.0 + 2.0 * np.pi / 3.0)
    a, b, d = a - lowest, b - lowest, d - lowest
    x, y, z = e * f - g * b, g * e - a * f, a * b - e * e
    u, v, w = b * d - f * f, f * g - e * d, e * f - b * g
    if u * u + v * v + w * w > x * x + y * y + z * z:
        x, y, z = u, v, w
    u, v, w = f * g - d * e, d * a - g * g, g * e - f * a
    if u * u + v * v + w * w > x * x + y * y + z * z:
        x, y, z = u, v, w
    length = np.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return 0.0, 0.0, 1.0
    return x / length, y / length, z / length


@njit(cache=True, nogil=True)
def cholesky_solve(a: Floats, b: Floats) -> bool:
    """Solve a x = b in place by Cholesky (lower half of `a` used); False if not positive definite."""
    n = len(b)
    for j in range(n):
        for i in range(j, n):
            s = a[i, j]
            for k in range(j):
                s -= a[i, k] * a[j, k]
            if i == j:
                if s <= 1e-10:
                    return False
                a[j, j] = np.sqrt(s)
            else:
                a[i, j] = s / a[j, j]
    for i in range(n):
        for k in range(i):
            b[i] -= a[i, k] * b[k]
        b[i] /= a[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= a[k, i] * b[k]
        b[i] /= a[i, i]
    return True


@njit(cache=True, nogil=True)
def plane_heights(points: Floats, nearest: Ints, width: int, first: int, last: int) -> tuple[Floats, Floats]:
    """Height (m,) of the points from `first` to before `last` over the plane of their neighbours, and these
    neighbours' rms about it (m,).

    The first `width` of `nearest` (n, k) count; the point itself, which is first, takes no part.
    """
    height, scatter = np.empty(last - first), np.empty(last - first)
    frame = np.empty((3, 3))
    for i in range(first, last):
        near = nearest[i, 1:width]
        mx, my, mz = _tangent_frame(points, near, frame)
        nx, ny, nz = frame[2, 0], frame[2, 1], frame[2, 2]
        total = 0.0
        for q in near:
            w = (points[q, 0] - mx) * nx + (points[q, 1] - my) * ny + (points[q, 2] - mz) * nz
            total += w * w
        scatter[i - first] = np.sqrt(total / (width - 1))
        height[i - first] = (points[i, 0] - mx) * nx + (points[i, 1] - my) * ny + (points[i, 2] - mz) * nz
    return height, scatter
