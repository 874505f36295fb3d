"""What the twin's fit needs of the nominal: a mesh that can bend, and nodes scattered over it."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.sparse as sp

from geometry.blade.nominal import Nominal
from geometry.blade.solid import face_areas_mm2
from geometry.deformation.freeform import Lattice, lattice_over
from geometry.deformation.offset import Nodes, Plate, plate_over, scatter_nodes
from geometry.deformation.refine import Refined, refine
from geometry.types import Floats, Ints

COARSER = 2.5  # spacing of the nodes that the wear is fitted to, in those of the offset
EDGE_CELLS = 0.27  # longest edge of the mesh, in cells of the lattice
CREASE_COSINE = 0.94  # corner normals that differ more belong to different sides of an edge


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ground:
    """A nominal prepared for fits with about so many nodes."""

    nominal: Nominal
    lattice: Lattice
    refined: Refined
    plate: Plate
    bulge_mm: Floats  # (nodes,) how far a smooth surface stands over the nominal's facets there
    graph: Ints  # (nodes, k) neighbours
    coarse: Nodes  # what the wear is fitted to
    coarse_of: Ints  # (nodes,) the nearest of these
    from_coarse: sp.csr_array  # (nodes, coarse) carries what is known there
    side_vertex: Ints  # (sides,) of the refined mesh: every vertex, then the other sides of its edges
    side_normals: Floats  # (sides, 3)
    to_sides: sp.csr_array  # (sides, nodes) carries what is known at the nodes

    @property
    def nodes(self) -> Nodes:
        """The nodes of the offset."""
        return self.plate.nodes


@lru_cache(maxsize=2)
def prepare_ground(nominal: Nominal, nodes: int, cells: int) -> Ground:
    """The ground with about so many nodes and cells of the lattice, kept from one part to the next."""
    lattice = lattice_over(nominal.samples.points_mm, cells)
    refined = refine(
        nominal.mesh, nominal.mesh_normals.corner, nominal.airfoil_face, EDGE_CELLS * lattice.cell_mm
    )
    fine = _scatter(nominal, refined, nodes)
    coarse = scatter_nodes(fine.points_mm, fine.normals, 1.0, COARSER * fine.spacing_mm)
    vertex, normals = refined.sides(CREASE_COSINE)
    return Ground(
        nominal=nominal,
        lattice=lattice,
        refined=refined,
        plate=plate_over(fine),
        bulge_mm=nominal.bulge_mm[nominal.closest(fine.points_mm).face],
        graph=fine.graph(),
        coarse=coarse,
        coarse_of=coarse.owner(fine.points_mm, fine.normals),
        from_coarse=coarse.interpolation(fine.points_mm, fine.normals),
        side_vertex=vertex,
        side_normals=normals,
        to_sides=fine.interpolation(refined.mesh.vertices_mm[vertex], normals),
    )


def _scatter(nominal: Nominal, refined: Refined, wanted: int) -> Nodes:
    """About `wanted` nodes over the airfoil, more where it turns."""
    mesh = refined.mesh
    area_mm2 = np.where(nominal.airfoil_face[refined.parent], face_areas_mm2(mesh), 0.0)
    spacing_mm = float(np.sqrt(area_mm2.sum() / wanted))
    count = int(12.0 * area_mm2.sum() / spacing_mm**2)
    each_mm2 = float(area_mm2.sum()) / count
    face = np.searchsorted(np.cumsum(area_mm2), (np.arange(count) + 0.5) * each_mm2)
    # The R2 sequence (Roberts, 2018) spreads the points in their faces without clumps.
    u, v = np.modf(np.arange(count)[:, None] * np.array([0.7548776662466927, 0.5698402909980532]))[0].T
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    weights = np.stack([1.0 - u - v, u, v], axis=1)
    points_mm = np.einsum("nc,ncj->nj", weights, mesh.vertices_mm[mesh.faces[face]])
    normals = np.einsum("nc,ncj->nj", weights, refined.corner_normals[face])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    within = (points_mm[:, 2] >= nominal.z_min_mm) & (points_mm[:, 2] <= nominal.z_max_mm)
    return scatter_nodes(points_mm[within], normals[within], each_mm2, spacing_mm)
