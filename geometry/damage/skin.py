"""The surface of a closed mesh: signed distances, closest points, samples."""

from functools import lru_cache

import numpy as np

from geometry.kernels.implicit_solid import (
    closest_on_triangles,
    column_crossings,
    nodes_inside,
    triangle_cells,
)
from geometry.kernels.parts import over_parts
from geometry.types import Bools, Floats, Ints, Mesh

MAX_CELLS = 2_000_000


class Skin:
    """The surface of a closed mesh, asked for signed distances (positive outside)."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.triangles_mm = mesh.vertices_mm[mesh.faces]
        a, b, c = np.moveaxis(self.triangles_mm, 1, 0)
        cross = np.cross(b - a, c - a)
        length = np.linalg.norm(cross, axis=1)
        self.area_mm2 = 0.5 * length
        self.normals = cross / np.maximum(length, 1e-300)[:, None]
        self.low_mm, self.high_mm = mesh.vertices_mm.min(axis=0), mesh.vertices_mm.max(axis=0)
        extent_mm = np.maximum(self.high_mm - self.low_mm, 1e-6)
        edge_mm = 2.0 * float(np.median(np.linalg.norm(b - a, axis=1)))
        self._cell_mm = max(edge_mm, float(np.cbrt(np.prod(extent_mm) / MAX_CELLS)))
        x, y, z = np.ceil(extent_mm / self._cell_mm).astype(int)
        self._cells = (max(int(x), 1), max(int(y), 1), max(int(z), 1))
        self._start, self._member = triangle_cells(self.triangles_mm, self.low_mm, self._cell_mm, self._cells)

    def closest(self, points_mm: Floats) -> tuple[Floats, Floats, Ints]:
        """Signed distance (n,), closest point (n, 3) and its face (n,) for every point (n, 3)."""
        order = self._by_cell(points_mm)  # neighbours ask the same triangles: they lie in the cache
        ordered_mm, back = points_mm[order], np.argsort(order)
        parts = over_parts(lambda first, end: self._closest(ordered_mm[first:end]), len(points_mm))
        distance_mm, feet_mm, face = (np.concatenate(part) for part in zip(*parts, strict=True))
        return distance_mm[back], feet_mm[back], face[back]

    def _closest(self, points_mm: Floats) -> tuple[Floats, Floats, Ints]:
        cells = (self._start, self._member, self.low_mm, self._cell_mm, self._cells)
        return closest_on_triangles(points_mm, self.triangles_mm, self.normals, *cells)

    def _by_cell(self, points_mm: Floats) -> Ints:
        """An order of the points in which those of one cell follow each other."""
        x, y, z = (
            np.clip((points_mm - self.low_mm) / self._cell_mm, 0, np.array(self._cells) - 1).astype(int).T
        )
        return np.asarray(np.argsort((x * self._cells[1] + y) * self._cells[2] + z, kind="stable"))

    def nodes_inside(self, low_mm: Floats, step_mm: float, shape: tuple[int, int, int]) -> Bools:
        """Which nodes of a grid of `shape`, from `low_mm` (3,) on, lie inside."""
        start, height_mm = column_crossings(self.triangles_mm, low_mm[:2], step_mm, shape[:2])
        return np.asarray(nodes_inside(start, height_mm, float(low_mm[2]), step_mm, shape))

    def samples(self, pitch_mm: float, low_mm: Floats, high_mm: Floats) -> tuple[Floats, Floats]:
        """Points (n, 3) spread evenly over the faces in a box, pitch squared each, and their normals."""
        corner = self.triangles_mm
        face = np.flatnonzero((corner.max(axis=1) >= low_mm).all(1) & (corner.min(axis=1) <= high_mm).all(1))
        area = np.cumsum(self.area_mm2[face])
        count = int(area[-1] / pitch_mm**2) if len(face) else 0
        index = np.arange(count)
        own = face[np.searchsorted(area, (index + 0.5) * pitch_mm**2)]
        u, v = index * 0.7548776662466927 % 1.0, index * 0.5698402909980532 % 1.0  # R2 sequence, Roberts 2018
        u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
        a, b, c = np.moveaxis(corner[own], 1, 0)
        points = a + u[:, None] * (b - a) + v[:, None] * (c - a)
        within = ((points >= low_mm) & (points <= high_mm)).all(axis=1)
        return points[within], self.normals[own[within]]


@lru_cache(maxsize=2)
def skin_of(mesh: Mesh) -> Skin:
    """The skin of a mesh, made once for all steps that ask it."""
    return Skin(mesh)
