"""Smooth deformation of the airfoil: a volumetric cubic B-spline that moves it and swells it."""

from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy.sparse as sp
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from scipy.linalg.lapack import dtbtrs

from geometry.errors import CannotFitTwin
from geometry.kernels.ffd import assemble, evaluate
from geometry.types import Floats, Ints

COMPONENTS = 4  # three of the shift of space, one of the swelling along the surface normal
MARGIN_CELLS = 0.5  # of the lattice beyond the points it was laid over
FADE_CELLS = 3.0  # beyond the lattice the displacement dies out over this distance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lattice:
    """Uniform control nodes in the axes of the airfoil, the longest last, so that the equations are narrow."""

    axes: Floats  # (3, 3) unit rows
    origin_mm: Floats  # (3,) in those axes
    cell_mm: float
    counts: Ints  # (3,) control nodes an axis; the spline lives on counts - 3 cells

    def local(self, points_mm: Floats) -> tuple[Floats, Floats]:
        """The nearest points (n, 3) of the lattice's domain, in cells, and how far beyond it they were (n,)."""
        cells = (points_mm @ self.axes.T - self.origin_mm) / self.cell_mm
        inside = np.ascontiguousarray(np.clip(cells, 0.0, self.counts - 3.0))
        return inside, np.linalg.norm(cells - inside, axis=1)

    def directions(self, normals: Floats) -> Floats:
        """What a unit of each component moves the surface along its normals (n, 3): (n, COMPONENTS)."""
        return np.column_stack([normals @ self.axes.T, np.ones(len(normals))])


def lattice_over(points_mm: Floats, cells: int) -> Lattice:
    """The lattice of about `cells` cubic cells over the box of the points (n, 3) in their principal axes."""
    _, axes = np.linalg.eigh(np.cov(points_mm.T))
    axes = axes[:, np.argsort(np.ptp(points_mm @ axes, axis=0))]
    own = points_mm @ axes
    low, extent = own.min(axis=0), np.ptp(own, axis=0)
    cell_mm = float(np.cbrt(extent.prod() / cells))
    spans = np.ceil(extent / cell_mm + 2.0 * MARGIN_CELLS).astype(np.int64)
    origin_mm = low + 0.5 * extent - 0.5 * cell_mm * spans
    return Lattice(axes=np.ascontiguousarray(axes.T), origin_mm=origin_mm, cell_mm=cell_mm, counts=spans + 3)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Freeform:
    """A fitted deformation with its posterior."""

    lattice: Lattice
    coefficients: Floats  # (nodes, COMPONENTS) mm
    factor: Floats  # (width, unknowns) banded Cholesky factor of the inverse covariance
    stiffness: Floats  # (COMPONENTS,) inverse variance of the prior, per unit of bending energy

    def shift(self, points_mm: Floats) -> tuple[Floats, Floats]:
        """Shift (n, 3) and swelling (n,) at points; beyond the lattice both die out smoothly."""
        inside, beyond = self.lattice.local(points_mm)
        far = np.minimum(beyond / FADE_CELLS, 1.0)
        values = evaluate(inside, self.lattice.counts, self.coefficients)
        values *= ((1.0 - far) ** 2 * (1.0 + 2.0 * far))[:, None]
        return values[:, :3] @ self.lattice.axes, values[:, 3]

    def displacement(self, points_mm: Floats, normals: Floats) -> Floats:
        """Displacement (n, 3) of surface points with unit normals (n, 3)."""
        shift, swelling = self.shift(points_mm)
        return np.asarray(shift + swelling[:, None] * normals)

    def along(self, points_mm: Floats, normals: Floats) -> Floats:
        """Displacement (n,) of surface points along their unit normals (n, 3)."""
        shift, swelling = self.shift(points_mm)
        return np.asarray(np.einsum("nj,nj->n", shift, normals) + swelling)

    def draws(self, rng: np.random.Generator, points_mm: Floats, normals: Floats, count: int) -> Floats:
        """Posterior draws (n, count) of the error along `normals`; beyond the lattice they grow instead."""
        inside, beyond = self.lattice.local(points_mm)
        errors = _posterior(self.factor, rng, count).reshape(-1, COMPONENTS * count)
        spread = evaluate(inside, self.lattice.counts, errors).reshape(-1, COMPONENTS, count)
        along = np.einsum("nd,ndc->nc", self.lattice.directions(normals), spread)
        return np.asarray(along * (1.0 + beyond[:, None]) ** 2)


def _posterior(factor: Floats, rng: np.random.Generator, count: int) -> Floats:
    """Draws (unknowns, count) from the zero-mean Gaussian whose inverse covariance has this Cholesky factor."""
    noise = rng.standard_normal((factor.shape[1], count))
    draws, info = dtbtrs(factor, noise, uplo="L", trans="T")
    if info != 0:
        raise CannotFitTwin(f"posterior is singular at unknown {info}")
    return np.asarray(draws)


def bending_energy(lattice: Lattice) -> sp.csr_array:
    """The matrix (nodes, nodes) whose form is the integral of the squared second derivatives, mm per mm2."""
    grams = [[_gram(int(n), order) for order in range(3)] for n in lattice.counts]
    total: sp.csr_array | None = None
    for i, j in product(range(3), repeat=2):
        order = [(axis == i) + (axis == j) for axis in range(3)]
        term = sp.kron(grams[2][order[2]], sp.kron(grams[1][order[1]], grams[0][order[0]]), format="csr")
        total = term if total is None else total + term
    return sp.csr_array(total / lattice.cell_mm)


def _gram(count: int, order: int) -> sp.csr_array:
    """Integrals of products of the `order`-th derivatives of the `count` basis functions, cell length 1."""
    # The four weights on a cell as polynomials, highest power first.
    cubics = ([-1, 3, -3, 1], [3, -6, 0, 4], [-3, 3, 3, 1], [1, 0, 0, 0])
    pieces = [np.polyder(np.array(p) / 6.0, order) for p in cubics]
    cell = np.array([[np.polyval(np.polyint(np.polymul(a, b)), 1.0) for b in pieces] for a in pieces])
    gram = np.zeros((count, count))
    for first in range(count - 3):
        gram[first : first + 4, first : first + 4] += cell
    return sp.csr_array(gram)


def fit_freeform(
    lattice: Lattice,
    bending: sp.csr_array,
    feet_mm: Floats,
    normals: Floats,
    offsets_mm: Floats,
    weights: Floats,
    *,
    stiffness: Floats,
    tangential: float,
) -> Freeform:
    """The most probable deformation that moves surface points (n, 3) by `offsets_mm` (n,) along their normals.

    `weights` (n,) are inverse variances, `stiffness` those of the prior. The stiffness of the returned field is
    updated by the degrees of freedom that the data took (MacKay, 1992), to be used in the next round.
    """
    nx, ny, _ = (int(n) for n in lattice.counts)
    unknowns = COMPONENTS * int(lattice.counts.prod())
    width = COMPONENTS * (3 * nx * ny + 3 * nx + 3) + COMPONENTS
    bands, right = np.zeros((unknowns, width)), np.zeros(unknowns)
    inside, _ = lattice.local(feet_mm)
    assemble(inside, lattice.directions(normals), offsets_mm, weights, tangential, lattice.counts, bands, right)
    lower = sp.coo_array(sp.tril(bending))
    for c in range(COMPONENTS):
        bands[COMPONENTS * lower.col + c, COMPONENTS * (lower.row - lower.col)] += stiffness[c] * lower.data
    bands[:, 0] *= 1.0 + 1e-9
    try:
        factor = cholesky_banded(bands.T, lower=True, overwrite_ab=True, check_finite=False)
    except LinAlgError as error:
        raise CannotFitTwin(f"free-form equations are singular: {error}") from error
    coefficients = cho_solve_banded((factor, True), right).reshape(-1, COMPONENTS)
    updated = _updated(factor, bending, coefficients, stiffness)
    return Freeform(lattice=lattice, coefficients=coefficients, factor=factor, stiffness=updated)


def _updated(factor: Floats, bending: sp.csr_array, coefficients: Floats, stiffness: Floats) -> Floats:
    """Degrees of freedom that the data determine over the energy in them, for the shift and for the swelling."""
    draws = 24
    samples = _posterior(factor, np.random.default_rng(len(coefficients)), draws)
    fields = samples.reshape(-1, COMPONENTS * draws)
    energy = np.sum(fields * (bending @ fields), axis=0).reshape(COMPONENTS, draws).mean(axis=1)
    held = stiffness * energy
    spent = np.sum(coefficients * (bending @ coefficients), axis=0)
    updated = np.empty(COMPONENTS)
    for group in (slice(0, 3), slice(3, 4)):
        count = len(coefficients) * len(spent[group])
        updated[group] = max(count - held[group].sum(), 1.0) / max(float(spent[group].sum()), 1e-12)
    return updated
