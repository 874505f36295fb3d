"""Scattered points as a surface: their spacing, frames and quadrics."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from geometry.types import Bools, Floats, Ints

FIT_POINTS = 24  # points of one local quadric


def frames_along(normals: Floats) -> Floats:
    """Right-handed frames (n, 3, 3) whose rows are two tangents and the normal."""
    first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first), normals], axis=1)


def spacings_mm(points_mm: Floats) -> Floats:
    """Spacing (n,) of the points round each: the side of the square that is each one's share."""
    count = min(8, len(points_mm) - 1)
    distance_mm, _ = cKDTree(points_mm).query(points_mm, count + 1)
    return np.asarray(np.maximum(distance_mm[:, -1], 1e-6) * np.sqrt(np.pi / count))


def thinned(points_mm: Floats, cell_mm: float) -> Floats:
    """The mean of the points in each occupied cell: repeated points gain no weight."""
    return gathered(points_mm, points_mm, cell_mm) / gathered(
        points_mm, np.ones((len(points_mm), 1)), cell_mm
    )


def gathered(points_mm: Floats, values: Floats, cell_mm: float) -> Floats:
    """The sums (cells, k) of the points' values (n, k) over each occupied cell."""
    cell = np.floor((points_mm - points_mm.min(axis=0)) / cell_mm).astype(np.int64)
    group = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    return np.column_stack([np.bincount(group, column) for column in values.T])


def local_quadrics(at_mm: Floats, points_mm: Floats) -> tuple[Floats, Floats, Floats]:
    """Feet (n, 3), frames (n, 3, 3) and bending (n, 3) of least-squares quadrics of the points (m, 3).

    The first frame is the principal axes of the neighbours, the second the quadric's own tangent plane.
    """
    distance_mm, index = cKDTree(points_mm).query(at_mm, min(FIT_POINTS, len(points_mm)))
    off = points_mm[index] - at_mm[:, None]
    weight = np.maximum(1.0 - (distance_mm / (1.2 * distance_mm[:, -1:])) ** 2, 0.0) ** 2
    mean = (weight[..., None] * off).sum(axis=1, keepdims=True) / weight.sum(axis=1)[:, None, None]
    spread = np.einsum("nk,nki,nkj->nij", weight, off - mean, off - mean)
    frames = np.linalg.eigh(spread)[1].transpose(0, 2, 1)[:, ::-1].copy()
    for _ in range(2):
        u, v, height = np.moveaxis(np.einsum("nij,nkj->nki", frames, off), 2, 0)
        design = np.stack([np.ones_like(u), u, v, 0.5 * u * u, u * v, 0.5 * v * v], -1)
        normal = np.einsum("nk,nki,nkj->nij", weight, design, design)
        ridge = 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(6)
        right = np.einsum("nk,nki,nk->ni", weight, design, height)
        fit = np.linalg.solve(normal + ridge, right[..., None])[..., 0]
        feet_mm = at_mm + fit[:, :1] * frames[:, 2]
        frames = _tilted(frames, fit[:, 1:3])
    return feet_mm, frames, fit[:, 3:]


def turn_over(frames: Floats, bending: Floats, which: Bools) -> None:
    """Turn the normals of these quadrics round, their frames (n, 3, 3) still right-handed."""
    frames[which, 1:] *= -1.0
    bending[np.ix_(which, np.array([0, 2]))] *= -1.0


def quadric_terms(u: Floats, v: Floats) -> Floats:
    """The terms (..., 6) of a full quadric at places: 1, u, v, u^2, u v, v^2."""
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


def _tilted(frames: Floats, slope: Floats) -> Floats:
    """Frames whose normals are those of surfaces with that slope (n, 2) in the old ones."""
    normal = frames[:, 2] - slope[:, :1] * frames[:, 0] - slope[:, 1:] * frames[:, 1]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    first = frames[:, 0] - (frames[:, 0] * normal).sum(1, keepdims=True) * normal
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normal, first), normal], axis=1)


def pieces(points_mm: Floats, link_mm: float) -> Ints:
    """Component (n,) of points that hang together when nearer than `link_mm`."""
    pairs = cKDTree(points_mm).query_pairs(link_mm, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs), np.int8), tuple(pairs.T)), shape=(len(points_mm),) * 2)
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)
