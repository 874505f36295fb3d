"""Plane sections of a closed triangle mesh."""

import numpy as np
from numba import njit

from geometry.types import Floats, Ints


@njit(cache=True, nogil=True)
def cut_faces(vertices: Floats, faces: Ints, z: float) -> tuple[Ints, Ints, Ints, Ints]:
    """The faces that the plane at height `z` crosses, and the directed edges where it enters and leaves.

    Returns (m,) faces, (m, 2) entry and (m, 2) exit edges as corner numbers of the face, and (m, 2, 2) the
    same edges as vertex numbers, lower first. A vertex on the plane counts as below, so every crossing
    is on an edge and every edge that is crossed is crossed by both its faces. Entry to exit runs
    counter-clockwise round the solid seen from +z.
    """
    count = 0
    for f in range(len(faces)):
        above = 0
        for corner in range(3):
            above += vertices[faces[f, corner], 2] > z
        count += 0 < above < 3
    cut, entry = np.empty(count, np.int64), np.empty((count, 2), np.int64)
    leave, edges = np.empty((count, 2), np.int64), np.empty((count, 2, 2), np.int64)
    m = 0
    for f in range(len(faces)):
        found = 0
        for corner in range(3):
            after = (corner + 1) % 3
            a, b = faces[f, corner], faces[f, after]
            up_a, up_b = vertices[a, 2] > z, vertices[b, 2] > z
            if up_a == up_b:
                continue
            found += 1
            side = 0 if up_a else 1
            target = entry if up_a else leave
            target[m, 0], target[m, 1] = corner, after
            edges[m, side, 0], edges[m, side, 1] = min(a, b), max(a, b)
        if found:
            cut[m] = f
            m += 1
    return cut, entry, leave, edges


@njit(cache=True, nogil=True)
def chain_loops(follower: Ints) -> tuple[Ints, Ints]:
    """The cycles of a permutation: members in walking order (m,), and the offsets of each cycle."""
    count = len(follower)
    members, offsets = np.empty(count, np.int64), np.empty(count + 1, np.int64)
    seen = np.zeros(count, np.bool_)
    at, loops = 0, 0
    for start in range(count):
        if seen[start]:
            continue
        offsets[loops] = at
        loops += 1
        i = start
        while not seen[i]:
            seen[i] = True
            members[at] = i
            at += 1
            i = follower[i]
    offsets[loops] = count
    return members, offsets[: loops + 1]
