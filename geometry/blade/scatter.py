"""Points spread over a mesh."""

import numpy as np

from geometry.blade.solid import face_areas_mm2
from geometry.types import Bools, Floats, Ints, Mesh


def even_points(mesh: Mesh, wanted: Bools, per_mm2: float) -> tuple[Floats, Ints, float]:
    """Points (n, 3) spread evenly over the wanted faces (m,), the face of each, the area of each.

    The faces are filled in order, one point an equal share of area; where in its face a point lies
    follows the R2 sequence (Roberts, 2018): no chance, and no clumps.
    """
    area_mm2 = np.where(wanted, face_areas_mm2(mesh), 0.0)
    count = max(1, round(float(area_mm2.sum()) * per_mm2))
    each_mm2 = float(area_mm2.sum()) / count
    face = np.searchsorted(np.cumsum(area_mm2), (np.arange(count) + 0.5) * each_mm2)
    u, v = np.modf(np.arange(count)[:, None] * np.array([0.7548776662466927, 0.5698402909980532]))[0].T
    u, v = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
    a, b, c = np.moveaxis(mesh.vertices_mm[mesh.faces[face]], 1, 0)
    points_mm = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    return points_mm, face, each_mm2
