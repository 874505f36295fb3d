"""Closed triangle meshes in float64: what a simulated blade is made of, its slices and its files."""

from dataclasses import dataclass
from pathlib import Path

import manifold3d
import numpy as np
import trimesh
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


class NotASolid(ValueError):
    """A mesh that encloses no volume; its text is one line that says what is wrong."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solid:
    """A closed, oriented triangle mesh: `vertices_mm` (n, 3), `faces` (m, 3), outside counter-clockwise."""

    vertices_mm: Floats
    faces: Ints

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices_mm, dtype=np.float64)
        faces = np.ascontiguousarray(self.faces, dtype=np.int64)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or not np.isfinite(vertices).all():
            raise NotASolid(f"vertices of shape {vertices.shape} are not finite points (n, 3)")
        if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) < 4:
            raise NotASolid(f"faces of shape {faces.shape} enclose nothing")
        object.__setattr__(self, "vertices_mm", vertices)
        object.__setattr__(self, "faces", faces)

    @property
    def volume_mm3(self) -> float:
        """The enclosed volume by the divergence theorem, from a nearby origin."""
        a, b, c = (self.vertices_mm - self.vertices_mm.mean(axis=0))[self.faces.T]
        return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)

    def moved(self, T: Floats) -> "Solid":
        """The solid after the rigid motion `T` (4x4)."""
        return Solid(vertices_mm=self.vertices_mm @ T[:3, :3].T + T[:3, 3], faces=self.faces)


def to_manifold(solid: Solid) -> manifold3d.Manifold:
    """The same solid for exact Boolean operations; `NotASolid` says why it is not one."""
    mesh = manifold3d.Mesh64(
        vert_properties=solid.vertices_mm, tri_verts=np.ascontiguousarray(solid.faces, dtype=np.uint64)
    )
    manifold = manifold3d.Manifold(mesh)
    if manifold.status() != manifold3d.Error.NoError:
        raise NotASolid(f"not a closed manifold: {manifold.status().name}, {_edge_faults(solid.faces)}")
    if manifold.volume() <= 0.0:
        raise NotASolid("the faces look inward: enclosed volume is not positive")
    return manifold


def from_manifold(manifold: manifold3d.Manifold) -> Solid:
    """The mesh of a Boolean result."""
    mesh = manifold.to_mesh64()
    return Solid(
        vertices_mm=np.array(mesh.vert_properties[:, :3]), faces=np.array(mesh.tri_verts, dtype=np.int64)
    )


def _edge_faults(faces: Ints) -> str:
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, counts = np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)
    return f"{int((counts == 1).sum())} open edges, {int((counts > 2).sum())} edges of more than two faces"


def face_normals(solid: Solid) -> tuple[Floats, Floats]:
    """Unit normals (m, 3) and areas (m,) of the faces; a face without area has a zero normal."""
    a, b, c = solid.vertices_mm[solid.faces.T]
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(length, 1e-300)[:, None], 0.5 * length


def vertex_normals(solid: Solid) -> Floats:
    """Unit normals (n, 3) of the vertices, area-weighted means of the faces around."""
    normals, areas = face_normals(solid)
    total = np.zeros_like(solid.vertices_mm)
    for corner in range(3):
        np.add.at(total, solid.faces[:, corner], normals * areas[:, None])
    return total / np.maximum(np.linalg.norm(total, axis=1), 1e-300)[:, None]


def slice_loops(solid: Solid, z_mm: float) -> list[Floats]:
    """The loops (m, 2) in which the plane z = `z_mm` cuts the solid, solid to the left.

    A vertex exactly in the plane counts as above, so that every crossing lies inside an edge.
    """
    height = solid.vertices_mm[:, 2] - z_mm
    above = height >= 0.0
    a, b, c = above[solid.faces.T]
    crossed = solid.faces[(a | b | c) & ~(a & b & c)]
    start, end = _falling(crossed, above), _falling(crossed, ~above)
    edges, index = np.unique(np.sort(np.concatenate([start, end]), axis=1), axis=0, return_inverse=True)
    weight = height[edges[:, 0]] / (height[edges[:, 0]] - height[edges[:, 1]])
    ends = solid.vertices_mm[edges][:, :, :2]
    points = ends[:, 0] + weight[:, None] * (ends[:, 1] - ends[:, 0])
    successor = np.full(len(edges), -1, dtype=np.int64)
    successor[index[: len(start)]] = index[len(start) :]
    return [points[loop] for loop in _cycles(successor)]


def _falling(faces: Ints, above: NDArray[np.bool_]) -> Ints:
    """Per crossed face, its edge (from, to) that leaves the side `above`.

    Seen from outside, counter-clockwise, a face falls through the plane on the left and rises on the
    right: going from the one to the other keeps the solid on the left seen from +Z.
    """
    leaves = above[faces] & ~above[np.roll(faces, -1, axis=1)]
    corner = leaves.argmax(axis=1)[:, None]
    return np.concatenate([np.take_along_axis(faces, (corner + k) % 3, axis=1) for k in range(2)], axis=1)


def _cycles(successor: Ints) -> list[list[int]]:
    following = successor.tolist()
    seen = [False] * len(following)
    loops = []
    for start in range(len(following)):
        loop = []
        at = start
        while not seen[at]:
            seen[at] = True
            loop.append(at)
            at = following[at]
        if len(loop) > 2:
            loops.append(loop)
    return loops


def loop_area_mm2(loop: Floats) -> float:
    """The signed area of a closed polygon (m, 2), positive when counter-clockwise."""
    x, y = loop.T
    return float(0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def read_solid(path: Path) -> Solid:
    """The solid of a mesh file (STL, PLY, OBJ, 3MF), vertices of equal coordinates merged.

    Raises `NotASolid` with one line that names the file when it is unreadable or not closed.
    """
    try:
        mesh = trimesh.load(path, process=False, force="mesh")
        solid = merged(np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64))
        to_manifold(solid)
    except NotASolid as fault:
        raise NotASolid(f"{path}: {fault}") from None
    except Exception as fault:
        raise NotASolid(f"{path}: not a readable mesh ({fault})") from fault
    return solid


def merged(vertices_mm: Floats, faces: Ints) -> Solid:
    """The mesh with vertices of exactly equal coordinates made one and collapsed faces dropped."""
    unique, index = np.unique(vertices_mm, axis=0, return_inverse=True)
    faces = index.ravel()[faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return Solid(vertices_mm=unique, faces=faces[whole])


STL_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def write_stl(path: Path, solid: Solid) -> None:
    """Write a binary STL. Its float32 rounds a coordinate near 100 mm by up to 4 nm."""
    facets = np.zeros(len(solid.faces), dtype=STL_FACET)
    facets["normal"] = face_normals(solid)[0]
    facets["corners"] = solid.vertices_mm[solid.faces]
    header = b"binary STL, mm".ljust(80) + np.uint32(len(facets)).tobytes()
    path.write_bytes(header + facets.tobytes())


def write_point_ply(path: Path, points_mm: Floats) -> None:
    """Write points (n, 3) as a binary little-endian PLY of doubles x, y, z."""
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment mm\n"
        f"element vertex {len(points_mm)}\n"
        "property double x\nproperty double y\nproperty double z\nend_header\n"
    )
    path.write_bytes(header.encode("ascii") + np.ascontiguousarray(points_mm, dtype="<f8").tobytes())
