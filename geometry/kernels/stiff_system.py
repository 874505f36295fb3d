"""The equations of affine transformations at the nodes of a graph, tied to their neighbours.

Node i has unknowns x_i (4, 3): the transposed 3x4 transformation that acts on q_i = (x, y, z, 1). Its
equation is  alpha sum_j c_ij (x_i - x_j) + w_i q_i q_i^T x_i = r_i.  The graph is in compressed rows:
neighbours `columns[offsets[i] : offsets[i + 1]]`, tied `ties` times each.
"""

import numpy as np
from numba import njit

from geometry.types import Floats, Ints


@njit(cache=True, nogil=True)
def apply_system(
    x: Floats, offsets: Ints, columns: Ints, ties: Floats, alpha: float, places: Floats, weights: Floats
) -> Floats:
    """The left side (n, 4, 3) of the equations for the unknowns x (n, 4, 3)."""
    result = np.empty_like(x)
    for i in range(len(x)):
        for d in range(3):
            seen = 0.0
            for a in range(4):
                seen += places[i, a] * x[i, a, d]
            for a in range(4):
                result[i, a, d] = weights[i] * places[i, a] * seen
        for k in range(offsets[i], offsets[i + 1]):
            j, tie = columns[k], alpha * ties[k]
            for a in range(4):
                for d in range(3):
                    result[i, a, d] += tie * (x[i, a, d] - x[j, a, d])
    return result


@njit(cache=True, nogil=True)
def relax(
    x: Floats,
    right: Floats,
    offsets: Ints,
    columns: Ints,
    ties: Floats,
    alpha: float,
    places: Floats,
    weights: Floats,
    backward: bool,
) -> None:
    """One Gauss-Seidel sweep over the nodes, in order or backward, in place.

    Each node's equation is solved exactly: its block alpha d I + w q q^T is inverted by the formula of
    Sherman and Morrison.
    """
    count = len(x)
    value = np.empty((4, 3))
    for step in range(count):
        i = count - 1 - step if backward else step
        value[:] = right[i]
        degree = 0.0
        for k in range(offsets[i], offsets[i + 1]):
            j, tie = columns[k], alpha * ties[k]
            degree += tie
            for a in range(4):
                for d in range(3):
                    value[a, d] += tie * x[j, a, d]
        size = 0.0
        for a in range(4):
            size += places[i, a] * places[i, a]
        damped = weights[i] / (degree + weights[i] * size)
        for d in range(3):
            seen = 0.0
            for a in range(4):
                seen += places[i, a] * value[a, d]
            for a in range(4):
                x[i, a, d] = (value[a, d] - damped * seen * places[i, a]) / degree
