"""A mesh with its long edges halved until it can bend; every new vertex lies exactly on the old mesh."""

from dataclasses import dataclass

import numpy as np

from geometry.types import Bools, Floats, Ints, Mesh

# Corners of the children of a face, by which of its edges (0-1, 1-2, 2-0) are halved: 0-2 the old corners,
# 3-5 the midpoints of those edges. A face with two halved edges leaves a quadrilateral; see `_children`.
_WHOLE = {
    (0, 0, 0): [(0, 1, 2)],
    (1, 0, 0): [(0, 3, 2), (3, 1, 2)],
    (0, 1, 0): [(0, 1, 4), (0, 4, 2)],
    (0, 0, 1): [(0, 1, 5), (5, 1, 2)],
    (1, 1, 1): [(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)],
}
_TWO = {
    # (halved): the tip triangle, then the quadrilateral in order; its two diagonals are the choice.
    (1, 1, 0): ((3, 1, 4), (0, 3, 4, 2)),
    (0, 1, 1): ((4, 2, 5), (1, 4, 5, 0)),
    (1, 0, 1): ((5, 0, 3), (2, 5, 3, 1)),
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Refined:
    """A refined mesh: children of one face follow each other, in the order of the faces."""

    mesh: Mesh
    parent: Ints  # (faces,) face of the original mesh, ascending
    corner_normals: Floats  # (faces, 3, 3) unit, interpolated in the parent face

    def sides(self, crease_cosine: float) -> tuple[Ints, Floats]:
        """Every vertex (k,) with its normal (k, 3), in order; then once more for each other side of an edge
        through it, where corner normals differ by more than the cosine says."""
        corner_vertex, corner_normal = self.mesh.faces.ravel(), self.corner_normals.reshape(-1, 3)
        _, first = np.unique(corner_vertex, return_index=True)
        main = corner_normal[first]
        along = np.einsum("cj,cj->c", corner_normal, main[corner_vertex])
        other = np.flatnonzero(along < crease_cosine)
        alike = np.round(corner_normal[other] * 64.0).astype(np.int64)
        _, extra = np.unique(np.column_stack([corner_vertex[other], alike]), axis=0, return_index=True)
        extra = other[extra]
        return (
            np.concatenate([np.arange(len(first)), corner_vertex[extra]]),
            np.concatenate([main, corner_normal[extra]]),
        )


def refine(mesh: Mesh, corner_normals: Floats, bends: Bools, longest_mm: float) -> Refined:
    """`mesh` with every edge of a face that `bends` (faces,) at most `longest_mm` long."""
    vertices, faces, normals = mesh.vertices_mm, mesh.faces, corner_normals
    parent = np.arange(len(faces))
    while True:
        edge, pairs = _edges(faces)
        wanted = np.zeros(len(pairs), np.bool_)
        wanted[edge[bends[parent]]] = True
        length_mm = np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)
        halved = wanted & (length_mm > longest_mm)
        if not halved.any():
            break
        middle = np.where(halved, len(vertices) + np.cumsum(halved) - 1, -1)
        vertices = np.concatenate([vertices, vertices[pairs[halved]].mean(axis=1)])
        faces, normals, source = _children(vertices, faces, normals, middle[edge])
        parent = parent[source]
    order = np.argsort(parent, kind="stable")
    normals = normals / np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-300)
    return Refined(
        mesh=Mesh(vertices_mm=vertices, faces=faces[order]),
        parent=parent[order],
        corner_normals=normals[order],
    )


def _edges(faces: Ints) -> tuple[Ints, Ints]:
    """Edge number (m, 3) of each face's edges 0-1, 1-2, 2-0, and the vertices (edges, 2) of each edge."""
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2)
    low, high = ends.min(axis=2), ends.max(axis=2)
    count = int(faces.max()) + 1
    keys, edge = np.unique(low * count + high, return_inverse=True)
    return edge.reshape(-1, 3), np.stack([keys // count, keys % count], axis=1)


def _children(vertices: Floats, faces: Ints, normals: Floats, middle: Ints) -> tuple[Ints, Floats, Ints]:
    """Faces, corner normals and source face of the mesh whose edges with a `middle` vertex are halved."""
    corners = np.concatenate([faces, middle], axis=1)
    looks = np.concatenate([normals, 0.5 * (normals + np.roll(normals, -1, axis=1))], axis=1)
    halved = middle >= 0
    pieces: list[tuple[Ints, Floats, Ints]] = []

    def take(source: Ints, child: tuple[int, ...]) -> None:
        pieces.append((corners[source][:, child], looks[source][:, child], source))

    for pattern, children in _WHOLE.items():
        source = np.flatnonzero((halved == np.array(pattern, np.bool_)).all(axis=1))
        for child in children:
            take(source, child)
    for pattern, (tip, (a, b, c, d)) in _TWO.items():
        source = np.flatnonzero((halved == np.array(pattern, np.bool_)).all(axis=1))
        take(source, tip)
        first = np.linalg.norm(vertices[corners[source, a]] - vertices[corners[source, c]], axis=1)
        second = np.linalg.norm(vertices[corners[source, b]] - vertices[corners[source, d]], axis=1)
        for chosen, splits in (
            (first <= second, ((a, b, c), (a, c, d))),
            (first > second, ((a, b, d), (b, c, d))),
        ):
            for child in splits:
                take(source[chosen], child)
    return (
        np.concatenate([p[0] for p in pieces]),
        np.concatenate([p[1] for p in pieces]),
        np.concatenate([p[2] for p in pieces]),
    )
