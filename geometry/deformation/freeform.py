"""A smooth deformation of the airfoil that is quick to ask: a volumetric cubic B-spline."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from geometry.kernels.ffd import evaluate
from geometry.types import Floats, Ints

MARGIN_CELLS = 0.5  # of the lattice beyond the points it was laid over
FADE_CELLS = 5.0  # beyond the lattice the displacement dies out over this distance


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lattice:
    """Uniform control nodes in the axes of the airfoil, the longest last."""

    axes: Floats  # (3, 3) unit rows
    origin_mm: Floats  # (3,) in those axes
    cell_mm: float
    counts: Ints  # (3,) control nodes an axis; the spline lives on counts - 3 cells

    def own(self, points_mm: Floats) -> Floats:
        """Points (n, 3) in the axes of the lattice."""
        return np.ascontiguousarray(points_mm @ self.axes.T)

    def local(self, points_mm: Floats) -> tuple[Floats, Floats]:
        """The nearest points (n, 3) of the lattice's domain, in cells, and how far beyond it they were
        (n,)."""
        cells = (self.own(points_mm) - self.origin_mm) / self.cell_mm
        inside = np.ascontiguousarray(np.clip(cells, 0.0, self.counts - 3.0))
        return inside, np.linalg.norm(cells - inside, axis=1)

    def interpolate(self, field: Callable[[Floats], Floats]) -> Floats:
        """Coefficients (nodes, m) of the spline that follows a smooth field, which is given points (n, 3) in
        the axes of the lattice.

        Quasi-interpolation of fourth order (de Boor, A Practical Guide to Splines, chapter XII).
        """
        ticks = [self.origin_mm[i] + self.cell_mm * np.arange(-2, self.counts[i]) for i in range(3)]
        c, b, a = np.meshgrid(ticks[2], ticks[1], ticks[0], indexing="ij")
        values = field(np.column_stack([a.ravel(), b.ravel(), c.ravel()])).reshape(*c.shape, -1)
        for axis in range(3):
            low, middle, high = (_part(values, axis, first) for first in range(3))
            values = (8.0 * middle - low - high) / 6.0
        return np.ascontiguousarray(values.reshape(-1, values.shape[-1]))


def _part(values: Floats, axis: int, first: int) -> Floats:
    """All but two of the values along an axis, from the `first` on."""
    return np.take(values, np.arange(first, values.shape[axis] - 2 + first), axis=axis)


def lattice_over(points_mm: Floats, cells: int) -> Lattice:
    """The lattice of about `cells` cubic cells over the box of dense surface points (n, 3) in their axes."""
    _, axes = np.linalg.eigh(np.cov(points_mm.T))
    axes = np.ascontiguousarray(axes[:, np.argsort(np.ptp(points_mm @ axes, axis=0))].T)
    own = points_mm @ axes.T
    low, extent = own.min(axis=0), np.ptp(own, axis=0)
    cell_mm = float(np.cbrt(extent.prod() / cells))
    spans = np.ceil(extent / cell_mm + 2.0 * MARGIN_CELLS).astype(np.int64)
    origin_mm = low + 0.5 * extent - 0.5 * cell_mm * spans
    return Lattice(axes=axes, origin_mm=origin_mm, cell_mm=cell_mm, counts=spans + 3)


def swell(normals: Floats) -> Floats:
    """How much of the swelling each unit normal (n, 3) feels: an airfoil thickens in its sections, not
    along z."""
    return np.asarray(1.0 - normals[:, 2] ** 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Freeform:
    """A deformation that moves the airfoil and swells it along its normals."""

    lattice: Lattice
    coefficients: Floats  # (nodes, 4) mm: three of the shift in the lattice's axes, one of the swelling

    def since(self, before: "Freeform") -> "Freeform":
        """What has changed since another one on the same lattice."""
        return Freeform(lattice=self.lattice, coefficients=self.coefficients - before.coefficients)

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
