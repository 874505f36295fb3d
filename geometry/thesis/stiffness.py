"""The stiff equations of non-rigid registration, and their solution at any size (thesis eq. 5.4 to 5.6).

One affine transformation a node, tied to those of its neighbours. The same matrix serves x, y and z. It is
never formed: conjugate gradients, preconditioned by Gauss-Seidel over the nodes and a direct solution over
patches of nodes, need a few tens of passes whatever the number of nodes.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import SuperLU, splu

from geometry.errors import CannotFitTwin
from geometry.kernels.stiff_system import apply_system, relax
from geometry.types import Floats, Ints

PATCH_TERMS = 7  # what a patch can do: a linear part (3), and a shift that is linear in place (1 + 3)
RIDGE = 1e-9  # of the patch equations' diagonal: patches of a few nodes do not tell all terms
MOST_STEPS = 500


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stiffness:
    """The graph of the nodes and the patches over it, prepared once for all steps of a registration."""

    places: Floats  # (n, 4) homogeneous
    offsets: Ints
    columns: Ints
    ties: Floats
    linear: sp.csr_array  # (n, patches) a patch's linear part at its nodes
    shift: sp.csr_array  # (n, 4 patches) its shift at its nodes
    seen: sp.csr_array  # (n, 7 patches) where it moves each node
    stiff: sp.csr_array  # (7 patches, 7 patches) ties between patches at alpha = 1


def prepare_stiffness(points_mm: Floats, neighbours: Ints, patch: Ints) -> Stiffness:
    """Ties from each node (n, 3) to its neighbours (n, k; -1 none), each way once (eq. 5.5).

    `patch` (n,) numbers from 0 the patch that each node belongs to.
    """
    count = len(points_mm)
    rows = np.repeat(np.arange(count), neighbours.shape[1])
    linked = neighbours.ravel() >= 0
    ends = (rows[linked], neighbours.ravel()[linked])
    one_way = sp.csr_array((np.ones(len(ends[0])), ends), shape=(count, count))
    ties = sp.csr_array(one_way + one_way.T)
    degree = np.asarray(ties.sum(axis=1)).ravel()
    if not (degree > 0.0).all():
        raise CannotFitTwin(f"{int((degree == 0.0).sum())} nodes have no neighbour")
    linear, shift, seen = _patch_terms(points_mm, patch)
    laplacian = sp.csr_array(sp.diags_array(degree) - ties)
    parts = [linear.T @ laplacian @ linear] * 3 + [shift.T @ laplacian @ shift]
    return Stiffness(
        places=np.column_stack([points_mm, np.ones(count)]),
        offsets=ties.indptr.astype(np.int64),
        columns=ties.indices.astype(np.int64),
        ties=ties.data,
        linear=linear,
        shift=shift,
        seen=seen,
        stiff=sp.csr_array(sp.block_diag(parts, format="csr")),
    )


def _patch_terms(points_mm: Floats, patch: Ints) -> tuple[sp.csr_array, sp.csr_array, sp.csr_array]:
    """What the terms of each patch do at its nodes: linear part, shift, and motion of the node itself."""
    count, patches = len(points_mm), int(patch.max()) + 1
    size = np.bincount(patch, minlength=patches)
    centre = np.column_stack([np.bincount(patch, x, minlength=patches) / size for x in points_mm.T])
    local = np.column_stack([np.ones(count), points_mm - centre[patch]])
    node = np.arange(count)
    linear = sp.csr_array((np.ones(count), (node, patch)), shape=(count, patches))
    at = patch[:, None] + patches * np.arange(PATCH_TERMS)
    shift = sp.csr_array((local.ravel(), (np.repeat(node, 4), at[:, :4].ravel())), shape=(count, 4 * patches))
    moves = np.column_stack([points_mm, local])
    seen = sp.csr_array(
        (moves.ravel(), (np.repeat(node, PATCH_TERMS), at.ravel())), shape=(count, PATCH_TERMS * patches)
    )
    return linear, shift, seen


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Equations:
    """The equations at one stiffness and one set of weights; `patches` may be those of earlier weights."""

    stiffness: Stiffness
    alpha: float
    weights: Floats
    patches: SuperLU

    def left(self, x: Floats) -> Floats:
        s = self.stiffness
        return apply_system(x, s.offsets, s.columns, s.ties, self.alpha, s.places, self.weights)

    def relaxed(self, x: Floats, right: Floats, *, backward: bool) -> Floats:
        s = self.stiffness
        relax(x, right, s.offsets, s.columns, s.ties, self.alpha, s.places, self.weights, backward)
        return x

    def approximate(self, right: Floats) -> Floats:
        """A quick symmetric approximation of the solution: sweep, patches, sweep back."""
        x = self.relaxed(np.zeros_like(right), right, backward=False)
        left_over = right - self.left(x)
        s = self.stiffness
        parts = [s.linear.T @ left_over[:, a] for a in range(3)] + [s.shift.T @ left_over[:, 3]]
        found = self.patches.solve(np.concatenate(parts))
        count = s.linear.shape[1]
        for a in range(3):
            x[:, a] += s.linear @ found[a * count : (a + 1) * count]
        x[:, 3] += s.shift @ found[3 * count :]
        return self.relaxed(x, right, backward=True)


def factor_patches(stiffness: Stiffness, alpha: float, weights: Floats) -> SuperLU:
    """The patch equations at one stiffness and one set of weights (n,), factored."""
    votes = sp.csr_array(stiffness.seen.T @ sp.diags_array(weights) @ stiffness.seen)
    system = sp.csc_array(alpha * stiffness.stiff + votes)
    diagonal = system.diagonal()
    ridge = RIDGE * np.maximum(diagonal, diagonal.mean() * RIDGE)
    return splu(
        sp.csc_array(system + sp.diags_array(ridge)),
        permc_spec="MMD_AT_PLUS_A",
        options={"SymmetricMode": True, "DiagPivotThresh": 0.0},
    )


def solve_stiff(
    stiffness: Stiffness,
    patches: SuperLU,
    alpha: float,
    weights: Floats,
    targets_mm: Floats,
    start: Floats,
    close_mm: float,
) -> tuple[Floats, int]:
    """The transformations (n, 4, 3) that minimise eq. 5.6, and the steps taken from `start` (n, 4, 3).

    `targets_mm` (n, 3) count by `weights` (n,). Stops when the error left, as the root mean square that it
    moves weighted nodes by, is estimated below `close_mm`. Raises `CannotFitTwin` if it does not settle.
    """
    equations = _Equations(stiffness=stiffness, alpha=alpha, weights=weights, patches=patches)
    x = start.copy()
    pulled = (weights[:, None] * stiffness.places)[:, :, None] * targets_mm[:, None, :]
    residual = pulled - equations.left(x)
    enough = close_mm**2 * float(weights.sum())
    direction = np.zeros_like(x)
    before = 1.0
    for step in range(MOST_STEPS):
        approximate = equations.approximate(residual)
        energy = float(np.vdot(residual, approximate))
        if not np.isfinite(energy):
            raise CannotFitTwin("the stiff equations have no finite solution")
        if energy <= enough:
            return x, step
        direction = approximate + (energy / before if step else 0.0) * direction
        image = equations.left(direction)
        length = energy / float(np.vdot(direction, image))
        x += length * direction
        residual -= length * image
        before = energy
    raise CannotFitTwin(f"the stiff equations do not settle in {MOST_STEPS} steps")
