"""A closed triangle mesh as a solid: proof that it is one, its normals, its plane sections."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from geometry.errors import BadMesh
from geometry.kernels.slicing import chain_loops, cut_faces
from geometry.types import Floats, Ints, Mesh

CREASE_DEG = 40.0  # a sharper fold is an edge of the part, not the facets of a curved surface


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Normals:
    """Outward normals of a mesh of m faces and n vertices."""

    face: Floats  # (m, 3) unit; zero where a face has no area
    corner: Floats  # (m, 3, 3) unit, one a corner, shared between faces that meet smoothly
    edge: Floats  # (m, 3, 3) sum of the two faces at the edge opposite each corner
    vertex: Floats  # (n, 3) angle-weighted sum of all faces around


def merge_vertices(vertices_mm: Floats, faces: Ints) -> Mesh:
    """The mesh with equal vertices made one, and without unused vertices and collapsed faces."""
    unique, index = np.unique(vertices_mm + 0.0, axis=0, return_inverse=True)  # + 0.0: no negative zeros
    merged = index.reshape(-1)[faces]
    a, b, c = merged.T
    merged = merged[(a != b) & (b != c) & (c != a)]
    used, compact = np.unique(merged, return_inverse=True)
    return Mesh(vertices_mm=unique[used], faces=compact.reshape(-1, 3))


def volume_mm3(mesh: Mesh) -> float:
    """Enclosed volume, positive if the faces are counter-clockwise seen from outside."""
    a, b, c = np.moveaxis(mesh.vertices_mm[mesh.faces] - mesh.vertices_mm.mean(axis=0), 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6.0


def check_solid(mesh: Mesh) -> None:
    """Raise `BadMesh` unless every edge has two faces that run it in opposite directions, around a volume."""
    if len(mesh.faces) < 4:
        raise BadMesh(f"{len(mesh.faces)} faces enclose nothing")
    forward = _directed_edges(mesh)
    if len(np.unique(forward)) != len(forward):
        raise BadMesh("faces are not consistently oriented, or an edge has more than two faces")
    backward = _directed_edges(Mesh(vertices_mm=mesh.vertices_mm, faces=mesh.faces[:, ::-1]))
    open_edges = len(np.setdiff1d(forward, backward, assume_unique=True))
    if open_edges:
        raise BadMesh(f"not closed: {open_edges} edges have one face only")
    volume = volume_mm3(mesh)
    if not volume > 0.0:
        raise BadMesh(f"inside out or flat: volume {volume:.6g} mm3")


def _directed_edges(mesh: Mesh) -> Ints:
    """Keys (3m,) of the edges as the faces run them: corner 0 to 1 of every face, 1 to 2, 2 to 0."""
    start, stop = mesh.faces.T.ravel(), np.roll(mesh.faces, -1, axis=1).T.ravel()
    return np.asarray(start * len(mesh.vertices_mm) + stop)


def faces_around(mesh: Mesh) -> tuple[Ints, Ints]:
    """Offsets (n + 1,) and faces (3m,): those around vertex v are `faces[offsets[v] : offsets[v + 1]]`."""
    corner_vertex = mesh.faces.ravel()
    counts = np.bincount(corner_vertex, minlength=len(mesh.vertices_mm))
    order = np.argsort(corner_vertex, kind="stable")
    return np.concatenate([[0], np.cumsum(counts)]), order // 3


def face_areas_mm2(mesh: Mesh) -> Floats:
    """Area (m,) of each face."""
    return 0.5 * np.asarray(np.linalg.norm(_face_vectors(mesh), axis=1))


def _face_vectors(mesh: Mesh) -> Floats:
    a, b, c = np.moveaxis(mesh.vertices_mm[mesh.faces], 1, 0)
    return np.cross(b - a, c - a)


def solid_normals(mesh: Mesh) -> Normals:
    """The normals of a mesh that `check_solid` passed.

    Angle-weighted pseudo-normals at edges and vertices give the right sign of distance everywhere
    (Baerentzen and Aanaes, 2005); corner normals are averaged over the faces round a vertex that meet
    at less than `CREASE_DEG`, so that a faceted curve reads as smooth and a real edge stays sharp.
    """
    face = _unit(_face_vectors(mesh))
    mate = _mates(mesh)
    across = face[mate // 3]  # (m, 3, 3): the face beyond the edge that starts at each corner
    weighted = (face[:, None, :] * _corner_angles(mesh)[:, :, None]).reshape(-1, 3)
    vertex = _sums(weighted, mesh.faces.ravel(), len(mesh.vertices_mm))
    smooth = np.einsum("mj,mcj->mc", face, across) > np.cos(np.deg2rad(CREASE_DEG))
    groups, group = _smooth_groups(mate, smooth)
    corner = _sums(weighted, group, groups)[group]
    flat = np.linalg.norm(corner, axis=1) < 1e-12
    corner[flat] = vertex[mesh.faces.ravel()[flat]]
    edge = np.roll(face[:, None, :] + across, -1, axis=1)  # the edge from corner c + 1 is opposite corner c
    return Normals(face=face, corner=_unit(corner).reshape(-1, 3, 3), edge=edge, vertex=vertex)


def facet_bulge_mm(mesh: Mesh, corner_normals: Floats) -> Floats:
    """Mean height (faces,) of a smooth surface through the corners, with their normals, over each facet."""
    corners_mm = mesh.vertices_mm[mesh.faces]
    edges_mm, turns = (np.roll(values, -1, axis=1) - values for values in (corners_mm, corner_normals))
    return np.asarray(np.sum(edges_mm * turns, axis=(1, 2)) / 24.0)


def _mates(mesh: Mesh) -> Ints:
    """For the edge that starts at each corner (m, 3), the corner number 3 f + c of its twin next door."""
    start, stop = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    count = len(mesh.vertices_mm)
    order = np.argsort(start * count + stop)
    at = np.searchsorted((start * count + stop)[order], stop * count + start)
    return np.asarray(order[at].reshape(-1, 3))


def _smooth_groups(mate: Ints, smooth: Floats) -> tuple[int, Ints]:
    """Number of groups and group (3m,) of each corner: corners of one vertex, joined over smooth edges."""
    corner = np.arange(mate.size).reshape(-1, 3)
    following = np.roll(corner, -1, axis=1)
    beyond = mate // 3 * 3 + (mate % 3 + 1) % 3  # the twin edge ends where this one starts
    rows = np.concatenate([corner[smooth], following[smooth]])
    columns = np.concatenate([beyond[smooth], mate[smooth]])
    links = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(mate.size, mate.size))
    groups, group = connected_components(links, directed=False)
    return int(groups), np.asarray(group, dtype=np.int64)


def _corner_angles(mesh: Mesh) -> Floats:
    """Inner angle (m, 3), rad, at each corner."""
    corners = mesh.vertices_mm[mesh.faces]
    forth, back = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    sine = np.linalg.norm(np.cross(forth, back), axis=2)
    return np.asarray(np.arctan2(sine, np.einsum("mcj,mcj->mc", forth, back)))


def _sums(vectors: Floats, group: Ints, groups: int) -> Floats:
    return np.column_stack([np.bincount(group, weights=vectors[:, i], minlength=groups) for i in range(3)])


def _unit(vectors: Floats) -> Floats:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0.0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Loop:
    """One closed loop of a plane section, counter-clockwise round the solid; each segment is in one face."""

    points_mm: Floats  # (m, 2)
    start_normals: Floats  # (m, 2) in the plane, of the face of segment i at its first point
    end_normals: Floats  # (m, 2) and at its last


def slice_loops(mesh: Mesh, corner_normals: Floats, z_mm: float) -> list[Loop]:
    """The loops of the exact section of a solid by the plane at `z_mm`; empty if it misses the solid."""
    face, entry, leave, edges = cut_faces(mesh.vertices_mm, mesh.faces, z_mm)
    keys = edges[..., 0] * len(mesh.vertices_mm) + edges[..., 1]
    order = np.argsort(keys[:, 0])
    follower = order[np.searchsorted(keys[order, 0], keys[:, 1])]
    points_mm = _on_edges(mesh.vertices_mm, edges[:, 0], z_mm)
    starts, ends = (_normals_at(mesh, corner_normals, face, corners, z_mm) for corners in (entry, leave))
    members, offsets = chain_loops(follower)
    pieces = np.split(members, offsets[1:-1]) if len(members) else []
    return [_loop(points_mm[i], starts[i], ends[i]) for i in pieces]


def _on_edges(vertices_mm: Floats, edges: Ints, z_mm: float) -> Floats:
    """Where the edges (m, 2 vertices) meet the plane: (m, 2), the same for both faces of an edge."""
    a, b = vertices_mm[edges[:, 0]], vertices_mm[edges[:, 1]]
    t = (z_mm - a[:, 2]) / (b[:, 2] - a[:, 2])
    return np.asarray((a + t[:, None] * (b - a))[:, :2])


def _normals_at(mesh: Mesh, corner_normals: Floats, face: Ints, corners: Ints, z_mm: float) -> Floats:
    z0, z1 = (mesh.vertices_mm[mesh.faces[face, corners[:, i]], 2] for i in range(2))
    t = ((z_mm - z0) / (z1 - z0))[:, None]
    normals = (1.0 - t) * corner_normals[face, corners[:, 0]] + t * corner_normals[face, corners[:, 1]]
    return _unit(normals[:, :2])


def _loop(points_mm: Floats, starts: Floats, ends: Floats) -> Loop:
    """The loop without the segments of no length that a vertex on the plane gives."""
    long = np.any(points_mm != np.roll(points_mm, -1, axis=0), axis=1)
    return Loop(points_mm=points_mm[long], start_normals=starts[long], end_normals=ends[long])
