"""Which side of a broken surface is metal."""

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from geometry.errors import CannotRepair
from geometry.types import Floats, Ints

LEAST_VOTE = 0.1  # mean cosine to the lost skin by which a piece shows its outer side
VOTERS = 1000  # points of a piece, at most, that are asked for it


def outward_sign(points_mm: Floats, normals: Floats, lost_mm: Floats, lost_normals: Floats) -> Floats:
    """For each normal (n, 3), +1 if it points away from metal and -1 if into it.

    Consistent over the neighbour graph, along its minimum spanning tree (Hoppe et al., 1992). Of two
    neighbours the normal of one is mirrored in the plane halfway between them (Koenig and Gumhold, 2009): so
    it carries round an arc, and through thin metal from one side to the other, where likeness alone would
    turn it inside out. Each connected piece as a whole looks towards the lost skin, of which samples and
    their normals are given.
    """
    tree = _likeness_tree(points_mm, normals)
    sign = np.zeros(len(points_mm))
    for first in range(len(points_mm)):
        if sign[first] == 0.0:
            piece, parent = breadth_first_order(tree, first, directed=False)
            _spread_sign(sign, points_mm, normals, piece, parent)
            some = piece[:: len(piece) // VOTERS + 1]
            sky = _towards(points_mm[some], lost_mm, lost_normals)
            vote = float((sign[some] * (normals[some] * sky).sum(axis=1)).mean())
            if not abs(vote) > LEAST_VOTE:
                raise CannotRepair("the broken surface does not show which side of it is metal")
            sign[piece] *= np.sign(vote)
    return sign


def _likeness_tree(points_mm: Floats, normals: Floats) -> csr_array:
    """The spanning tree over neighbours whose normals carry over best."""
    _, index = cKDTree(points_mm).query(points_mm, min(9, len(points_mm)))
    pairs = np.column_stack([np.repeat(index[:, 0], index.shape[1] - 1), index[:, 1:].ravel()])
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    weight = 1.0 + 1e-3 - np.abs(_likeness(points_mm, normals, pairs[:, 0], pairs[:, 1]))
    graph = coo_array((weight, tuple(pairs.T)), shape=(len(points_mm),) * 2)
    return minimum_spanning_tree(graph.tocsr())


def _likeness(points_mm: Floats, normals: Floats, of: Ints, to: Ints) -> Floats:
    """Cosine (p,) between the normals `to` and the normals `of` carried there."""
    apart_mm = points_mm[to] - points_mm[of]
    square_mm2 = np.maximum((apart_mm**2).sum(axis=1), 1e-12)
    across = (normals[of] * apart_mm).sum(axis=1) * (normals[to] * apart_mm).sum(axis=1) / square_mm2
    return np.asarray((normals[of] * normals[to]).sum(axis=1) - 2.0 * across)


def _spread_sign(sign: Floats, points_mm: Floats, normals: Floats, piece: Ints, parent: Ints) -> None:
    sign[piece[0]] = 1.0
    after = piece[1:]
    same = _likeness(points_mm, normals, parent[after], after) >= 0.0
    for node, keeps in zip(after, same, strict=True):
        sign[node] = sign[parent[node]] * (1.0 if keeps else -1.0)


def _towards(points_mm: Floats, lost_mm: Floats, lost_normals: Floats) -> Floats:
    """Mean direction (n, 3), unit, of the lost skin seen from each point, weighted by solid angle."""
    distance_mm = np.maximum(cdist(points_mm, lost_mm), 1e-3)
    across = np.abs((lost_mm * lost_normals).sum(axis=1) - points_mm @ lost_normals.T)
    weight = across / distance_mm**4
    mean = weight @ lost_mm - weight.sum(axis=1)[:, None] * points_mm
    return np.asarray(mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12))
