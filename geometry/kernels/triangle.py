"""Closest points on triangles, in float64."""

import numpy as np
from numba import njit

from geometry.types import Floats, Ints

FLAT_MARGIN = 0.02  # a foot this far (barycentric) inside its triangle cannot lie on a neighbour


@njit(cache=True, nogil=True, inline="always")
def _weights(px, py, pz, a, b, c):  # type: ignore[no-untyped-def]
    """Barycentric weights of the point of triangle `a b c` nearest to p (Ericson, 2004, section 5.1.5)."""
    abx, aby, abz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    acx, acy, acz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    apx, apy, apz = px - a[0], py - a[1], pz - a[2]
    d1 = abx * apx + aby * apy + abz * apz
    d2 = acx * apx + acy * apy + acz * apz
    if d1 <= 0.0 and d2 <= 0.0:
        return 1.0, 0.0, 0.0
    bpx, bpy, bpz = px - b[0], py - b[1], pz - b[2]
    d3 = abx * bpx + aby * bpy + abz * bpz
    d4 = acx * bpx + acy * bpy + acz * bpz
    if d3 >= 0.0 and d4 <= d3:
        return 0.0, 1.0, 0.0
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v = d1 / (d1 - d3)
        return 1.0 - v, v, 0.0
    cpx, cpy, cpz = px - c[0], py - c[1], pz - c[2]
    d5 = abx * cpx + aby * cpy + abz * cpz
    d6 = acx * cpx + acy * cpy + acz * cpz
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 0.0, 1.0
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = d2 / (d2 - d6)
        return 1.0 - w, 0.0, w
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 0.0, 1.0 - w, w
    scale = 1.0 / (va + vb + vc)
    return 1.0 - (vb + vc) * scale, vb * scale, vc * scale


@njit(cache=True, nogil=True)
def closest_on_triangles(points: Floats, triangles: Floats) -> Floats:
    """Barycentric weights (n, 3) of the point of triangle i (n, 3 corners, 3) nearest to point i (n, 3)."""
    weights = np.empty((len(points), 3))
    for i in range(len(points)):
        t = triangles[i]
        weights[i, 0], weights[i, 1], weights[i, 2] = _weights(
            points[i, 0], points[i, 1], points[i, 2], t[0], t[1], t[2]
        )
    return weights


@njit(cache=True, nogil=True)
def refine_closest(
    points: Floats, vertices: Floats, faces: Ints, start: Ints, ring_offsets: Ints, ring_faces: Ints
) -> tuple[Ints, Floats]:
    """Face (n,) and barycentric weights (n, 3) of the nearest mesh point, walking downhill from `start`.

    `ring_faces[ring_offsets[v] : ring_offsets[v + 1]]` are the faces around vertex v. A foot on the rim of
    its triangle is compared with every face that shares a vertex, until none is nearer.
    """
    count = len(points)
    face = np.empty(count, np.int64)
    weights = np.empty((count, 3))
    for i in range(count):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        best = start[i]
        w0, w1, w2 = _weights(
            px, py, pz, vertices[faces[best, 0]], vertices[faces[best, 1]], vertices[faces[best, 2]]
        )
        best2 = _distance2(px, py, pz, vertices, faces[best], w0, w1, w2)
        moved = min(w0, w1, w2) < FLAT_MARGIN
        while moved:
            moved = False
            centre = best
            for corner in range(3):
                vertex = faces[centre, corner]
                for j in range(ring_offsets[vertex], ring_offsets[vertex + 1]):
                    f = ring_faces[j]
                    u0, u1, u2 = _weights(
                        px, py, pz, vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
                    )
                    d2 = _distance2(px, py, pz, vertices, faces[f], u0, u1, u2)
                    if d2 < best2:
                        best, best2, w0, w1, w2 = f, d2, u0, u1, u2
                        moved = True
        face[i] = best
        weights[i, 0], weights[i, 1], weights[i, 2] = w0, w1, w2
    return face, weights


@njit(cache=True, nogil=True, inline="always")
def _distance2(px, py, pz, vertices, face, w0, w1, w2):  # type: ignore[no-untyped-def]
    a, b, c = vertices[face[0]], vertices[face[1]], vertices[face[2]]
    dx = px - (w0 * a[0] + w1 * b[0] + w2 * c[0])
    dy = py - (w0 * a[1] + w1 * b[1] + w2 * c[1])
    dz = pz - (w0 * a[2] + w1 * b[2] + w2 * c[2])
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, nogil=True)
def describe_feet(
    points: Floats,
    vertices: Floats,
    faces: Ints,
    face: Ints,
    weights: Floats,
    corner_normals: Floats,
    face_normals: Floats,
    edge_normals: Floats,
    vertex_normals: Floats,
) -> tuple[Floats, Floats, Floats]:
    """The mesh points (n, 3) of `face` and `weights`, the unit normals there, the signed distances (n,).

    Normals are interpolated between the corners.

    The sign is that of the offset against the pseudo-normal of what the foot lies on: the face, the edge
    opposite a corner of no weight, or the vertex.
    """
    count = len(points)
    feet, normals, distance = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
    for i in range(count):
        f = face[i]
        zeros, lost, kept = 0, 0, 0
        for corner in range(3):
            if weights[i, corner] == 0.0:
                zeros += 1
                lost = corner
            else:
                kept = corner
        length2, away2, side = 0.0, 0.0, 0.0
        for axis in range(3):
            foot, normal = 0.0, 0.0
            for corner in range(3):
                foot += weights[i, corner] * vertices[faces[f, corner], axis]
                normal += weights[i, corner] * corner_normals[f, corner, axis]
            if zeros == 0:
                pseudo = face_normals[f, axis]
            elif zeros == 1:
                pseudo = edge_normals[f, lost, axis]
            else:
                pseudo = vertex_normals[faces[f, kept], axis]
            feet[i, axis], normals[i, axis] = foot, normal
            length2 += normal * normal
            away = points[i, axis] - foot
            away2 += away * away
            side += away * pseudo
        for axis in range(3):
            normals[i, axis] /= np.sqrt(length2)
        distance[i] = np.sqrt(away2) if side >= 0.0 else -np.sqrt(away2)
    return feet, normals, distance
