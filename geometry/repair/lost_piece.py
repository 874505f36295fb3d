"""The twin within the body that cuts the lost metal out of it, as one closed solid."""

from dataclasses import dataclass
from typing import Any

import manifold3d
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from geometry.blade.solid import check_solid, face_areas_mm2, volume_mm3
from geometry.errors import CannotRepair
from geometry.types import Bools, Floats, Ints, Mesh


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Piece:
    """Lost metal as a closed, oriented solid."""

    mesh: Mesh
    outer: Bools  # (faces,) on the twin's skin; the others lie on the broken surface
    dropped_mm3: float  # of slivers left out

    def faces(self, chosen: Bools) -> tuple[Floats, Floats]:
        """Middles (n, 3) and areas (n,) of the chosen faces."""
        faces = Mesh(vertices_mm=self.mesh.vertices_mm, faces=self.mesh.faces[chosen])
        return faces.vertices_mm[faces.faces].mean(axis=1), face_areas_mm2(faces)

    def border_mm(self) -> Floats:
        """The vertices (n, 3) at which the skin and the broken surface meet."""
        return self.mesh.vertices_mm[
            np.intersect1d(self.mesh.faces[self.outer], self.mesh.faces[~self.outer])
        ]


def solid_of(mesh: Mesh) -> Any:
    """The mesh as a solid of manifold3d. Raises `CannotRepair` unless it is one."""
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(np.array(mesh.vertices_mm), np.array(mesh.faces, dtype=np.uint64))
    )
    if solid.status() != manifold3d.Error.NoError:
        raise CannotRepair(f"a body is not a solid: {solid.status()}")
    return solid


def lost_piece(solid: Any, body: Mesh, sliver_fraction: float) -> Piece:
    """The twin, `solid`, within the cut body, without pieces smaller than that share of the largest.

    Components by graph search on the faces: manifold3d's own decomposition does not come back from
    thousands of pieces.
    """
    if volume_mm3(body) < 0.0:
        body = Mesh(vertices_mm=body.vertices_mm, faces=body.faces[:, ::-1])
    raw = (solid ^ solid_of(body)).to_mesh64()
    vertices = np.asarray(raw.vert_properties)[:, :3]
    faces = np.asarray(raw.tri_verts).astype(np.int64)
    if not len(faces):
        raise CannotRepair("no metal is missing under the broken surface")
    component = _components(faces, len(vertices))
    a, b, c = np.moveaxis(vertices[faces] - vertices.mean(axis=0), 1, 0)
    volumes = np.bincount(component, np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0)
    kept = volumes >= sliver_fraction * volumes.max()
    own = kept[component]
    used, compact = np.unique(faces[own], return_inverse=True)
    mesh = Mesh(vertices_mm=vertices[used], faces=compact.reshape(-1, 3))
    check_solid(mesh)
    outer = _from_original(raw, solid.original_id())[own]
    if outer.all():
        raise CannotRepair("the patch has no broken side")
    return Piece(mesh=mesh, outer=outer, dropped_mm3=float(np.abs(volumes[~kept]).sum()))


def _components(faces: Ints, count: int) -> Ints:
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1][faces[:, 0]])


def _from_original(raw: Any, origin: int) -> Bools:
    runs = np.asarray(raw.run_index, dtype=np.int64) // 3
    mask = np.zeros(len(raw.tri_verts), bool)
    for own, first, last in zip(raw.run_original_id, runs[:-1], runs[1:], strict=True):
        mask[first:last] = own == origin
    return mask
