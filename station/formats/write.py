"""Points and meshes as the bytes of a file. Deterministic: the same arrays give the same bytes."""

import numpy as np
from numpy.typing import NDArray

from geometry.types import Floats, Ints, Mesh

CLOUD = np.dtype([("points_mm", "<f8", 3), ("deviation_mm", "<f4")])
FACE = np.dtype([("count", "u1"), ("vertices", "<i4", 3)])
FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])

Corners = NDArray[np.float32]


def ply_cloud(points_mm: Floats, deviation_mm: Floats) -> bytes:
    """Binary PLY of points (n, 3) in double with a float property `deviation_mm`."""
    table = np.empty(len(points_mm), CLOUD)
    table["points_mm"], table["deviation_mm"] = points_mm, deviation_mm
    header = ply_header(f"element vertex {len(points_mm)}", *axes(), "property float deviation_mm")
    return header + table.tobytes()


def ply_mesh(mesh: Mesh) -> bytes:
    """Binary PLY of a triangle mesh, vertices in double."""
    faces = np.empty(len(mesh.faces), FACE)
    faces["count"], faces["vertices"] = 3, mesh.faces
    header = ply_header(
        f"element vertex {len(mesh.vertices_mm)}",
        *axes(),
        f"element face {len(mesh.faces)}",
        "property list uchar int vertex_indices",
    )
    return header + mesh.vertices_mm.astype("<f8").tobytes() + faces.tobytes()


def axes() -> list[str]:
    return [f"property double {axis}" for axis in "xyz"]


def ply_header(*lines: str) -> bytes:
    head = ("ply", "format binary_little_endian 1.0", "comment nominal frame, mm")
    return "\n".join((*head, *lines, "end_header\n")).encode("ascii")


def stl(meshes: list[Mesh]) -> bytes:
    """Binary STL of closed meshes, mm, in float32. Raises `ValueError` when one is not closed."""
    corners = np.concatenate([np.empty((0, 3, 3), np.float32), *(rounded_corners(mesh) for mesh in meshes)])
    table = np.zeros(len(corners), FACET)
    table["corners"], table["normal"] = corners, facet_normals(corners)
    return b"bladecell mm".ljust(80, b" ") + np.uint32(len(corners)).tobytes() + table.tobytes()


def rounded_corners(mesh: Mesh) -> Corners:
    """Corners (m, 3, 3) of the facets, which join in float32 just as they do in double."""
    if not is_closed(mesh.faces):
        raise ValueError("the mesh is not closed")
    corners: Corners = set_apart(mesh.vertices_mm.astype(np.float32))[mesh.faces]
    return corners


def set_apart(vertices_mm: Corners) -> Corners:
    """The vertices (n, 3), each of those that lie where another does a step of float32 or a few aside.

    Readers tell corners by their place: vertices that rounding brings together could fold a mesh so that
    four facets meet in an edge.
    """
    apart_mm = vertices_mm.copy()
    while True:
        _, first, place = np.unique(apart_mm, axis=0, return_index=True, return_inverse=True)
        again = first[place.reshape(-1)] != np.arange(len(apart_mm))
        if not again.any():
            return apart_mm
        apart_mm[again, 0] = np.nextafter(apart_mm[again, 0], np.float32(np.inf))


def is_closed(faces: Ints) -> bool:
    """Whether every directed edge has its opposite, and only one."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    count = int(faces.max(initial=0)) + 1
    forward = np.sort(edges[:, 0] * count + edges[:, 1])
    backward = np.sort(edges[:, 1] * count + edges[:, 0])
    return bool((np.diff(forward) > 0).all() and np.array_equal(forward, backward))


def facet_normals(corners: Corners) -> Floats:
    """Unit normals (m, 3); zero for a facet without area, as the format has it."""
    exact = corners.astype(np.float64)
    normals = np.cross(exact[:, 1] - exact[:, 0], exact[:, 2] - exact[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, length, out=np.zeros_like(normals), where=length > 0.0)
