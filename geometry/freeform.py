"""Smooth deformation of the airfoil: a volumetric cubic B-spline that moves it and swells it."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from scipy.linalg.lapack import dtbtrs

from geometry.errors import CannotFitTwin
from geometry.kernels.ffd import add_block, evaluate, shapes
from geometry.types import Floats, Ints

COMPONENTS = 4  # three of the shift of space, one of the swelling along the surface normal
SKIRT_CELLS = 0.1  # a cell this near to surface bends, too
MARGIN_CELLS = 0.5  # of the lattice beyond the points it was laid over
LEAST_ROUGH = (
    0.44  # mean second derivative of a wave eight cells long: (2 pi / 8)^2 / sqrt(2) amplitudes per cell^2
)
FADE_CELLS = 3.0  # beyond the lattice the displacement dies out over this distance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lattice:
    """Uniform control nodes in the axes of the airfoil, the longest last, so that the equations are narrow.

    Only the cells that hold surface bend; the nodes of no such cell stay zero.
    """

    axes: Floats  # (3, 3) unit rows
    origin_mm: Floats  # (3,) in those axes
    cell_mm: float
    counts: Ints  # (3,) control nodes an axis; the spline lives on counts - 3 cells
    cells: Ints  # (cells, 64) nodes of each cell that holds surface, ascending; the first one names it
    unknown: Ints  # (nodes,) number of each node among the free ones; -1 the others

    @property
    def free(self) -> int:
        """Nodes that can move."""
        return int(self.unknown.max()) + 1

    def local(self, points_mm: Floats) -> tuple[Floats, Floats]:
        """The nearest points (n, 3) of the lattice's domain, in cells, and how far beyond it they were
        (n,)."""
        return _local(points_mm, self.axes, self.origin_mm, self.cell_mm, self.counts)

    def directions(self, normals: Floats) -> Floats:
        """What a unit of each component moves the surface along its normals (n, 3): (n, COMPONENTS)."""
        return np.column_stack([normals @ self.axes.T, swell(normals)])


def swell(normals: Floats) -> Floats:
    """How much of the swelling each unit normal (n, 3) feels: an airfoil thickens in its sections, not
    along z."""
    return np.asarray(1.0 - normals[:, 2] ** 2)


def _local(
    points_mm: Floats, axes: Floats, origin_mm: Floats, cell_mm: float, counts: Ints
) -> tuple[Floats, Floats]:
    cells = (points_mm @ axes.T - origin_mm) / cell_mm
    inside = np.ascontiguousarray(np.clip(cells, 0.0, counts - 3.0))
    return inside, np.linalg.norm(cells - inside, axis=1)


def lattice_over(points_mm: Floats, cells: int) -> Lattice:
    """The lattice of about `cells` cubic cells over the box of dense surface points (n, 3) in their axes."""
    _, axes = np.linalg.eigh(np.cov(points_mm.T))
    axes = np.ascontiguousarray(axes[:, np.argsort(np.ptp(points_mm @ axes, axis=0))].T)
    own = points_mm @ axes.T
    low, extent = own.min(axis=0), np.ptp(own, axis=0)
    cell_mm = float(np.cbrt(extent.prod() / cells))
    spans = np.ceil(extent / cell_mm + 2.0 * MARGIN_CELLS).astype(np.int64)
    origin_mm, counts = low + 0.5 * extent - 0.5 * cell_mm * spans, spans + 3
    inside, _ = _local(points_mm, axes, origin_mm, cell_mm, counts)
    around = [inside + SKIRT_CELLS * np.array(corner) for corner in product((-1.0, 1.0), repeat=3)]
    first, _ = shapes(np.clip(np.concatenate(around), 0.0, counts - 3.0), counts)
    steps = [(c * counts[1] + b) * counts[0] + a for c, b, a in product(range(4), repeat=3)]
    held = np.unique(first)[:, None] + np.array(steps, np.int64)
    unknown = np.full(int(counts.prod()), -1, np.int64)
    free = np.unique(held)
    unknown[free] = np.arange(len(free))
    return Lattice(
        axes=axes, origin_mm=origin_mm, cell_mm=cell_mm, counts=counts, cells=held, unknown=unknown
    )


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
        return np.asarray(shift + (swelling * swell(normals))[:, None] * normals)

    def along(self, points_mm: Floats, normals: Floats) -> Floats:
        """Displacement (n,) of surface points along their unit normals (n, 3)."""
        shift, swelling = self.shift(points_mm)
        return np.asarray(np.einsum("nj,nj->n", shift, normals) + swelling * swell(normals))

    def draws(self, rng: np.random.Generator, points_mm: Floats, normals: Floats, count: int) -> Floats:
        """Posterior draws (n, count) of the error along `normals`; beyond the lattice they grow instead."""
        inside, beyond = self.lattice.local(points_mm)
        errors = np.zeros((len(self.coefficients), COMPONENTS * count))
        errors[self.lattice.unknown >= 0] = _posterior(self.factor, rng, count).reshape(
            -1, COMPONENTS * count
        )
        spread = evaluate(inside, self.lattice.counts, errors).reshape(-1, COMPONENTS, count)
        along = np.einsum("nd,ndc->nc", self.lattice.directions(normals), spread)
        return np.asarray(along * (1.0 + beyond[:, None]) ** 2)


def _posterior(factor: Floats, rng: np.random.Generator, count: int) -> Floats:
    """Draws (unknowns, count) from the zero-mean Gaussian whose inverse covariance has this Cholesky
    factor."""
    noise = rng.standard_normal((factor.shape[1], count))
    draws, info = dtbtrs(factor, noise, uplo="L", trans="T")
    if info != 0:
        raise CannotFitTwin(f"posterior is singular at unknown {info}")
    return np.asarray(draws)


def bending_block() -> Floats:
    """The form (64, 64) of the squared second derivatives of a cell's nodes, integrated over a unit cell."""
    grams = [_gram(order) for order in range(3)]
    total = np.zeros((64, 64))
    for i, j in product(range(3), repeat=2):
        order = [(axis == i) + (axis == j) for axis in range(3)]
        total += np.kron(grams[order[2]], np.kron(grams[order[1]], grams[order[0]]))
    return total


def _gram(order: int) -> Floats:
    """Integrals (4, 4) of products of the `order`-th derivatives of the four weights over a unit cell."""
    cubics = ([-1, 3, -3, 1], [3, -6, 0, 4], [-3, 3, 3, 1], [1, 0, 0, 0])  # highest power first
    pieces = [np.polyder(np.array(p) / 6.0, order) for p in cubics]
    return np.array([[np.polyval(np.polyint(np.polymul(a, b)), 1.0) for b in pieces] for a in pieces])


def fit_freeform(
    lattice: Lattice,
    feet_mm: Floats,
    normals: Floats,
    offsets_mm: Floats,
    weights: Floats,
    *,
    stiffness: Floats,
    slide: float,
    form_mm: float,
) -> Freeform:
    """The most probable deformation that moves surface points (n, 3) by `offsets_mm` (n,) along their
    normals.

    `weights` (n,) are inverse variances. The prior's inverse variance is `stiffness` (COMPONENTS,) times the
    integral of the squared second derivatives; that of the returned field is updated by the degrees of
    freedom that the data took (MacKay, 1992), for the next round. Each point also asks for no shift at all
    with the inverse variance `slide`: the surface does not slide along itself where nothing holds it.
    A field with waves of `form_mm` is always thought possible, however calm the blade is where it was seen.
    """
    inside, _ = lattice.local(feet_mm)
    first, shape = shapes(inside, lattice.counts)
    rows = shape[:, :, None] * lattice.directions(normals)[:, None, :]
    rows = rows.reshape(len(feet_mm), -1) * np.sqrt(weights)[:, None]
    goals = offsets_mm * np.sqrt(weights)
    bands, right = np.zeros((COMPONENTS * lattice.free, _width(lattice))), np.zeros(COMPONENTS * lattice.free)
    bend, mine = bending_block() / lattice.cell_mm, _split(first, lattice.cells[:, 0])
    for nodes, points in zip(lattice.cells, mine, strict=True):
        unknowns = (COMPONENTS * lattice.unknown[nodes][:, None] + np.arange(COMPONENTS)).ravel()
        block = rows[points].T @ rows[points]
        still = slide * shape[points].T @ shape[points]
        for c in range(COMPONENTS):
            block[c::COMPONENTS, c::COMPONENTS] += stiffness[c] * bend + (still if c < 3 else 0.0)
        add_block(bands, unknowns, block)
        right[unknowns] += rows[points].T @ goals[points]
    factor = _factor(bands)
    solution = cho_solve_banded((factor, True), right)
    coefficients = np.zeros((len(lattice.unknown), COMPONENTS))
    coefficients[lattice.unknown >= 0] = solution.reshape(-1, COMPONENTS)
    return Freeform(
        lattice=lattice,
        coefficients=coefficients,
        factor=factor,
        stiffness=_updated(lattice, factor, solution, stiffness, form_mm),
    )


def _split(first: Ints, cells: Ints) -> list[Ints]:
    """The points in each cell, by the first nodes of the points (n,) and of the cells, ascending."""
    order = np.argsort(first, kind="stable")
    low, high = (np.searchsorted(first[order], cells, side=side) for side in ("left", "right"))
    return [order[a:b] for a, b in zip(low, high, strict=True)]


def _width(lattice: Lattice) -> int:
    """Bands of the equations: the farthest pair of unknowns in one cell, and the diagonal."""
    numbers = lattice.unknown[lattice.cells]
    return COMPONENTS * int((numbers[:, -1] - numbers[:, 0]).max() + 1)


def _factor(bands: Floats) -> Floats:
    bands[:, 0] *= 1.0 + 1e-9
    try:
        return np.asarray(cholesky_banded(bands.T, lower=True, overwrite_ab=True, check_finite=False))
    except LinAlgError as error:
        raise CannotFitTwin(f"free-form equations are singular: {error}") from error


def _updated(lattice: Lattice, factor: Floats, solution: Floats, stiffness: Floats, form_mm: float) -> Floats:
    """Degrees of freedom that the data determine over the energy in them, for the shift and for the
    swelling."""
    draws = 24
    errors = _posterior(factor, np.random.default_rng(lattice.free), draws)
    open_energy = _energies(lattice, errors).mean(axis=1)
    spent = _energies(lattice, solution[:, None])[:, 0]
    least = len(lattice.cells) * lattice.cell_mm**3 * (LEAST_ROUGH * form_mm / lattice.cell_mm**2) ** 2
    updated = np.empty(COMPONENTS)
    for group in (slice(0, 3), slice(3, 4)):
        freedom = lattice.free * len(spent[group]) - float((stiffness * open_energy)[group].sum())
        updated[group] = max(freedom, 1.0) / (float(spent[group].sum()) + least)
    return updated


def _energies(lattice: Lattice, solutions: Floats) -> Floats:
    """Bending energy (COMPONENTS, k) of k fields (unknowns, k)."""
    fields = solutions.reshape(lattice.free, -1)
    bend, total = bending_block() / lattice.cell_mm, np.zeros(fields.shape[1])
    for nodes in lattice.cells:
        values = fields[lattice.unknown[nodes]]
        total += np.einsum("nk,nk->k", values, bend @ values)
    return total.reshape(COMPONENTS, -1)
