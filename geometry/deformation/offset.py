"""A scalar field on a surface, offset along its normal: a thin plate that decays where nothing is seen."""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from scipy.sparse.csgraph import reverse_cuthill_mckee

from geometry.errors import CannotFitTwin
from geometry.kernels.neighbours import counting_sort
from geometry.kernels.thinplate import back_substitute, bending_rows, linear_weights, thin, within
from geometry.types import Bools, Floats, Ints

INTERPOLATION_REACH, INTERPOLATION_WIDTH = 1.8, 20
BENDING_REACH, BENDING_WIDTH = 2.5, 36


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Nodes:
    """Scattered nodes on a surface, no two nearer than `spacing_mm` (position and normal together)."""

    points_mm: Floats  # (n, 3)
    normals: Floats  # (n, 3)
    area_mm2: Floats  # (n,) of the surface nearest to each
    spacing_mm: float

    def near(self, points_mm: Floats, normals: Floats, reach: float, width: int) -> tuple[Ints, Floats]:
        """Nodes (m, width; -1 none) within `reach` spacings of surface points, nearest first, and how far."""
        edge_mm = reach * self.spacing_mm
        low_mm = self.points_mm.min(axis=0)
        at = ((self.points_mm - low_mm) / edge_mm).astype(np.int64)
        cells = at.max(axis=0) + 1
        starts, order = counting_sort(
            (at[:, 0] * cells[1] + at[:, 1]) * cells[2] + at[:, 2], int(cells.prod())
        )
        return within(
            points_mm,
            normals,
            self.points_mm,
            self.normals,
            order,
            starts,
            low_mm,
            cells,
            self.spacing_mm,
            reach,
            width,
        )

    def interpolation(self, points_mm: Floats, normals: Floats) -> sp.csr_array:
        """The matrix (m, nodes) that carries node values to surface points; rows sum
        to 1 within one spacing of a node and fall to 0 beyond."""
        found, rho = self.near(points_mm, normals, INTERPOLATION_REACH, INTERPOLATION_WIDTH)
        weights = linear_weights(
            points_mm, normals, self.points_mm, self.normals, found, rho, INTERPOLATION_REACH
        )
        fade = np.clip((INTERPOLATION_REACH - rho[:, 0]) / (INTERPOLATION_REACH - 1.0), 0.0, 1.0)
        return _rows(found, weights * fade[:, None], len(self.points_mm))

    def owner(self, points_mm: Floats, normals: Floats) -> Ints:
        """The nearest node (m,) of each surface point; -1 where none is within one spacing."""
        return np.ascontiguousarray(self.near(points_mm, normals, 1.0001, 1)[0][:, 0])

    def graph(self) -> Ints:
        """The neighbours (n, 9; -1 none) of each node."""
        return np.ascontiguousarray(
            self.near(self.points_mm, self.normals, INTERPOLATION_REACH, 10)[0][:, 1:]
        )


def _rows(found: Ints, values: Floats, columns: int) -> sp.csr_array:
    """The sparse matrix whose row i has `values[i]` at `found[i]`."""
    used = found >= 0
    offsets = np.concatenate([[0], np.cumsum(used.sum(axis=1))])
    return sp.csr_array((values[used], found[used], offsets), shape=(len(found), columns))


def scatter_nodes(points_mm: Floats, normals: Floats, each_mm2: float, spacing_mm: float) -> Nodes:
    """Nodes thinned from candidates (n, 3), which cover the surface evenly, one for each `each_mm2`."""
    low_mm = points_mm.min(axis=0)
    cells = (np.ptp(points_mm, axis=0) / spacing_mm).astype(np.int64) + 1
    kept = thin(points_mm, normals, spacing_mm, low_mm, cells)
    nodes = Nodes(
        points_mm=points_mm[kept],
        normals=normals[kept],
        area_mm2=np.ones(int(kept.sum())),
        spacing_mm=spacing_mm,
    )
    owner = nodes.owner(points_mm, normals)
    votes = np.bincount(owner[owner >= 0], minlength=len(nodes.points_mm)).astype(np.float64)
    return replace(nodes, area_mm2=each_mm2 * votes)


def bending_energy(nodes: Nodes) -> sp.csr_array:
    """The matrix (nodes, nodes) whose form is the integral of squared second derivatives over the surface."""
    found, rho = nodes.near(nodes.points_mm, nodes.normals, BENDING_REACH, BENDING_WIDTH)
    rows = bending_rows(nodes.points_mm, nodes.normals, found, rho, BENDING_REACH)
    weighted = rows * np.sqrt(nodes.area_mm2)[:, None, None]
    stacked = sp.vstack([_rows(found, weighted[:, m], len(nodes.points_mm)) for m in range(3)], format="csr")
    return sp.csr_array(stacked.T @ stacked)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Plate:
    """What the prior of the field needs of its nodes, whatever is measured."""

    nodes: Nodes
    bending: sp.csr_array  # (nodes, nodes)
    order: Ints  # (nodes,) in which its equations are a narrow band


def plate_over(nodes: Nodes) -> Plate:
    """The thin plate over these nodes."""
    bending = bending_energy(nodes)
    order = reverse_cuthill_mckee(bending, symmetric_mode=True).astype(np.int64)
    return Plate(nodes=nodes, bending=bending, order=order)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Offset:
    """The fitted field: values and posterior standard deviations at the nodes."""

    nodes: Nodes
    value_mm: Floats  # (n,)
    sigma_mm: Floats  # (n,)
    prior_sigma_mm: float
    held: Bools  # (n,) scan points speak for the node
    misfit_mm: Floats  # (m,) of the measured offsets


def fit_offset(
    plate: Plate,
    feet_mm: Floats,
    normals: Floats,
    offsets_mm: Floats,
    sigma_mm: Floats,
    count: Floats,
    *,
    prior_sigma_mm: float,
    length_mm: float,
    draws: int,
    rng: np.random.Generator,
) -> Offset:
    """The most probable offset field given offsets (m,) at surface points, each the mean of `count` (m,)
    measured ones, with its sigma.

    The prior is a thin plate on an elastic bed: spectrum 1 / (k^4 + 1 / length^4), standard deviation
    `prior_sigma_mm`; in a gap it runs on smoothly and returns to zero within a few `length_mm`.
    """
    nodes, order = plate.nodes, plate.order
    carry = nodes.interpolation(feet_mm, normals)
    bed = sp.diags_array(nodes.area_mm2 / length_mm**4)
    stiffness = length_mm**2 / (8.0 * prior_sigma_mm**2)
    information = 1.0 / sigma_mm**2
    system = sp.csr_array(carry.T @ (sp.diags_array(information) @ carry) + stiffness * (plate.bending + bed))
    right = carry.T @ (information * offsets_mm)
    factor = _banded_factor(sp.csr_array(system[order][:, order]))
    value, errors = np.empty(len(order)), np.empty((len(order), draws))
    value[order] = cho_solve_banded((factor, True), right[order])
    errors[order] = back_substitute(np.ascontiguousarray(factor.T), rng.standard_normal(errors.shape))
    votes = np.asarray(abs(carry).T @ count)
    return Offset(
        nodes=nodes,
        value_mm=value,
        sigma_mm=np.sqrt(np.mean(errors**2, axis=1)),
        prior_sigma_mm=prior_sigma_mm,
        held=votes >= max(1.0, 0.2 * float(np.median(votes))),
        misfit_mm=offsets_mm - carry @ value,
    )


def _banded_factor(system: sp.csr_array) -> Floats:
    lower = sp.coo_array(sp.tril(system))
    width = int((lower.row - lower.col).max()) + 1
    bands = np.zeros((system.shape[0], width))
    bands[lower.col, lower.row - lower.col] = lower.data
    try:
        return np.asarray(cholesky_banded(bands.T, lower=True, overwrite_ab=True, check_finite=False))
    except LinAlgError as error:
        raise CannotFitTwin(f"offset equations are singular: {error}") from error
