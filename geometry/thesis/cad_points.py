"""The nominal as the thesis has it: points sampled evenly from its surface."""

import numpy as np

from geometry.blade.nominal import Nominal
from geometry.blade.solid import face_areas_mm2
from geometry.deformation.offset import Nodes, scatter_nodes
from geometry.scan.surface import k_nearest
from geometry.types import Bools, Floats

DRAWN = 10.0  # candidates for each square of the pitch
PACKED = 1.5  # points that keep a distance s, as many as find room among them, have 1.5 s^2 of surface each


def pitch_of(points_mm: Floats, neighbours: int = 16) -> float:
    """The point spacing of a scan: side of the square of surface that a point has, at the median density."""
    _, distance_mm = k_nearest(points_mm, min(neighbours + 1, len(points_mm)))
    return float(np.median(distance_mm[:, -1]) * np.sqrt(np.pi / (distance_mm.shape[1] - 1)))


def sample_cad(nominal: Nominal, faces: Bools, pitch_mm: float) -> Nodes:
    """Points spread evenly over the chosen faces (m,), one a square of the pitch, no two near each other.

    Source: thesis 3.3.1 and 5.4.1, uniform sampling of the nominal with the point spacing of the scan.
    """
    area_mm2 = np.where(faces, face_areas_mm2(nominal.mesh), 0.0)
    count = max(1, round(DRAWN * float(area_mm2.sum()) / pitch_mm**2))
    each_mm2 = float(area_mm2.sum()) / count
    face = np.searchsorted(np.cumsum(area_mm2), (np.arange(count) + 0.5) * each_mm2)
    # Where in its face a point lies follows the R2 sequence (Roberts, 2018): spread without clumps.
    u, v = np.modf(np.arange(count)[:, None] * np.array([0.7548776662466927, 0.5698402909980532]))[0].T
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    a, b, c = np.moveaxis(nominal.mesh.vertices_mm[nominal.mesh.faces[face]], 1, 0)
    drawn_mm = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    normals = nominal.closest_from(drawn_mm, face).normals
    return scatter_nodes(drawn_mm, normals, each_mm2, pitch_mm / np.sqrt(PACKED))
