"""A penalised cubic tensor spline, periodic by open, whose smoothness its own data decide."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from geometry.kernels.profile import band_inverse, tensor_sums, tensor_values
from geometry.types import Floats, Ints

_OVERSTEP = 1.6  # the update creeps towards its fixed point from one side


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Stencil:
    """Layout of symmetric matrices over the tensor coefficients (p periodic and even, q open).

    A matrix is held as (p, 4, q, q), coefficient (i, k) against (i + d, l), and factored as a band: the
    periodic direction is folded (0, p - 1, 1, p - 2, ...), so that neighbours stay close across its seam.
    """

    p: int
    q: int
    place: Ints  # (p,) of each periodic index in the folded order
    width: int
    flat: Ints  # (p, 4, q, q) place in the raveled band

    def band(self, matrix: Floats) -> Floats:
        """The lower band storage of a matrix."""
        band = np.zeros(self.width * self.p * self.q)
        band[self.flat] = matrix
        return band.reshape(self.width, self.p * self.q)

    def fold(self, values: Floats) -> Floats:
        """(p, q, n) in band order: (p q, n)."""
        out = np.empty_like(values)
        out[self.place] = values
        return out.reshape(self.p * self.q, -1)

    def unfold(self, values: Floats) -> Floats:
        """The way back of `fold`."""
        return values.reshape(self.p, self.q, -1)[self.place]

    def inside(self, inverse: Floats) -> Floats:
        """The entries of an inverse, known inside the band, where matrices have any: (p, 4, q, q)."""
        return inverse.ravel()[self.flat]


@lru_cache(maxsize=64)
def stencil(p: int, q: int) -> Stencil:
    """The layout for p x q coefficients."""
    folded = np.column_stack([np.arange(p // 2), np.arange(p - 1, p // 2 - 1, -1)]).ravel()
    place = np.empty(p, np.int64)
    place[folded] = np.arange(p)
    i, d, k, m = np.ix_(np.arange(p), np.arange(4), np.arange(q), np.arange(q))
    row, column = place[i] * q + k, place[(i + d) % p] * q + m
    offset = np.abs(row - column)
    flat = offset * (p * q) + np.minimum(row, column)
    return Stencil(p=p, q=q, place=place, width=int(offset.max()) + 1, flat=flat)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Penalty:
    """Integrated squared curvatures of the spline: along the periodic direction, apart for several groups
    of coefficients, then along the open one. Matrix j is `along[j]` (x) 1, the last one `share` (x) `across`.
    """

    layout: Stencil
    along: Floats  # (groups, p, p)
    share: Floats  # (p,)
    across: Floats  # (q, q)

    def matrix(self, strength: Floats) -> Floats:
        """The sum of the matrices, each times its strength, as a stencil matrix."""
        p, q = self.layout.p, self.layout.q
        i, d = np.ix_(np.arange(p), np.arange(4))
        total = np.tensordot(strength[:-1], self.along, 1)
        out = total[i, (i + d) % p][:, :, None, None] * np.eye(q)
        out[:, 0] += strength[-1] * self.share[:, None, None] * self.across
        return out

    def times(self, values: Floats) -> Floats:
        """Every matrix times values (p, q, n): (matrices, p, q, n)."""
        along = np.tensordot(self.along, values, 1)
        across = self.share[:, None, None] * (self.across @ values)
        return np.concatenate([along, across[None]])

    def traces(self, inverse: Floats) -> Floats:
        """Trace of every matrix times an inverse, given where stencil matrices have entries."""
        p = self.layout.p
        i, d = np.ix_(np.arange(p), np.arange(4))
        blocks = np.trace(inverse, axis1=2, axis2=3) * np.array([1.0, 2.0, 2.0, 2.0])
        along = (self.along[:, i, (i + d) % p] * blocks).sum(axis=(1, 2))
        across = float((self.share @ inverse[:, 0].reshape(p, -1)) @ self.across.ravel())
        return np.append(along, across)

    def effective(self, strength: Floats) -> Floats:
        """Strength times trace(S^- S_j) for each matrix S_j of the sum S: the dimensions it penalises."""
        scale = 1.0 / np.sqrt(self.share)
        mu, vectors = np.linalg.eigh(scale[:, None] * np.tensordot(strength[:-1], self.along, 1) * scale)
        mu = np.where(mu > 1e-9 * mu[-1], mu, 0.0)
        nu = strength[-1] * np.linalg.eigvalsh(self.across)
        nu[:2] = 0.0  # straight lines bend nowhere
        total = mu[:, None] + nu
        inverse = np.divide(1.0, total, out=np.zeros_like(total), where=total > 0.0)
        scaled = scale[:, None] * vectors
        parts = (scaled * (self.along @ scaled)).sum(axis=1) @ inverse.sum(axis=1)
        return np.append(strength[:-1] * parts, (inverse * nu).sum())


def curvature_penalty(centre_mm: Floats, perimeter_mm: float, group: Ints, q: int, open_mm: float) -> Penalty:
    """The penalty for coefficients at `centre_mm` (p,) along the closed arc and every `open_mm` across.

    `group` (p,) numbers the groups 0, 1, ... whose smoothness along the arc is estimated apart.
    """
    p = len(centre_mm)
    step = (np.roll(centre_mm, -1) - centre_mm) % perimeter_mm
    before = np.roll(step, 1)
    share = 0.5 * (step + before)
    rows = np.zeros((p, p))
    here = np.arange(p)
    rows[here, here - 1] = 1.0 / (before * share)
    rows[here, (here + 1) % p] = 1.0 / (step * share)
    rows[here, here] = -(rows[here, here - 1] + rows[here, (here + 1) % p])
    second = np.diff(np.eye(q), 2, axis=0) / open_mm**2
    return Penalty(
        layout=stencil(p, q),
        along=np.stack(
            [open_mm * rows.T @ (rows * (share * (group == g))[:, None]) for g in range(int(group.max()) + 1)]
        ),
        share=share,
        across=open_mm * second.T @ second,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sums:
    """What the data say: the normal equations of spline coefficients and free columns."""

    gram: Floats  # (p, 4, q, q)
    right: Floats  # (p, q, 1)
    cross: Floats  # (p, q, e)
    free: Floats  # (e, e)
    free_right: Floats  # (e,)
    square: float
    count: int


def gather(u: Floats, v: Floats, y: Floats, weight: Floats, columns: Floats, layout: Stencil) -> Sums:
    """The sums of data `y` (n,) with `weight` (n,) at the spline coordinates (u, v)."""
    gram, right, cross = tensor_sums(u, v, y, weight, columns, (layout.p, layout.q))
    weighted = columns * weight[:, None]
    return Sums(
        gram=gram,
        right=right[:, :, None],
        cross=cross,
        free=columns.T @ weighted,
        free_right=weighted.T @ y,
        square=float(weight @ (y * y)),
        count=int(np.count_nonzero(weight)),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SplineFit:
    """Coefficients, and what is needed for their covariance (Bayesian posterior: noise and smoothness)."""

    layout: Stencil
    coefficients: Floats  # (p, q)
    free: Floats  # (e,)
    scale: float  # variance of data of weight 1
    strength: Floats  # of each penalty
    bending: Floats  # c' S c of each penalty, times its strength
    taken: Floats  # effective dimensions that each penalty takes away
    factor: Floats  # band Cholesky factor
    cross: Floats  # (p q, e), band order; more columns than `free` once functions are held
    schur: Floats  # (e, e)

    def values(self, u: Floats, v: Floats, columns: Floats) -> Floats:
        """The fitted function at (u, v)."""
        return tensor_values(u, v, self.coefficients) + columns @ self.free

    def covariance(self, spline: Floats, free: Floats) -> Floats:
        """Covariance (n, n) of n linear functions: weights `spline` (p, q, n) and `free` (e, n)."""
        folded = self.layout.fold(spline)
        solved = cho_solve_banded((self.factor, True), folded, check_finite=False)
        free = np.vstack([free, np.zeros((self.cross.shape[1] - len(free), free.shape[1]))])
        rest = free - self.cross.T @ solved
        return self.scale * (folded.T @ solved + rest.T @ np.linalg.solve(self.schur, rest))

    def held(self, weights: Floats, variance: Floats) -> "SplineFit":
        """The fit, told that the functions `weights` (p, q, n) of the spline are 0 with a `variance` (n,).

        As if each had been measured to be 0 (conditioning of a Gaussian posterior): the multipliers of these
        measurements join the free columns.
        """
        folded, old = self.layout.fold(weights), self.cross.shape[1]
        solved = cho_solve_banded((self.factor, True), np.hstack([self.cross, folded]), check_finite=False)
        cross = np.hstack([self.cross, folded])
        schur = -cross.T @ solved
        schur[:old, :old] = self.schur
        schur[old:, old:] -= np.diag(variance / self.scale)
        before = self.layout.fold(self.coefficients[:, :, None])[:, 0]
        wrong = np.concatenate([np.zeros(old), -(folded.T @ before)])
        step = np.linalg.solve(schur, wrong)
        after = self.layout.unfold((before - solved @ step)[:, None])[:, :, 0]
        free = self.free + step[: len(self.free)]
        return replace(self, coefficients=np.ascontiguousarray(after), free=free, cross=cross, schur=schur)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solution:
    """The normal equations solved: the spline eliminated first, then the free columns."""

    factor: Floats  # band Cholesky factor
    cross: Floats  # (p q, e), band order
    solved: Floats  # (p q, 1 + e) of the right side and of the cross sums
    schur: Floats  # (e, e)
    free: Floats  # (e,)
    folded: Floats  # (p q, 1) coefficients, band order

    def values(self, layout: Stencil) -> Floats:
        """The coefficients (p, q)."""
        return np.ascontiguousarray(layout.unfold(self.folded)[:, :, 0])


def eliminate(sums: Sums, penalty: Penalty, strength: Floats) -> Solution:
    """The solution at given strengths of the penalties."""
    layout = penalty.layout
    matrix = sums.gram + penalty.matrix(strength)
    matrix[:, 0] += 1e-9 * float(np.trace(sums.gram[:, 0].mean(axis=0))) / layout.q * np.eye(layout.q)
    factor = cholesky_banded(layout.band(matrix), lower=True, overwrite_ab=True, check_finite=False)
    right, cross = layout.fold(sums.right), layout.fold(sums.cross)
    solved = cho_solve_banded((factor, True), np.hstack([right, cross]), check_finite=False)
    schur = sums.free - cross.T @ solved[:, 1:]
    free = np.linalg.solve(schur, sums.free_right - cross.T @ solved[:, 0]).astype(np.float64)
    folded = solved[:, :1] - solved[:, 1:] @ free[:, None]
    return Solution(factor=factor, cross=cross, solved=solved, schur=schur, free=free, folded=folded)


def solve(sums: Sums, penalty: Penalty, strength: Floats) -> SplineFit:
    """The fit at given strengths of the penalties, with its scale and effective dimensions."""
    layout, found = penalty.layout, eliminate(sums, penalty, strength)
    coefficients = layout.unfold(found.folded)
    bending = strength * (penalty.times(coefficients) * coefficients).sum(axis=(1, 2, 3))
    inverse = layout.inside(band_inverse(found.factor))
    bent = layout.unfold(found.solved[:, 1:])
    taken = strength * (penalty.traces(inverse) + _correction(penalty, bent, found.schur))
    dimensions = layout.p * layout.q + len(found.free) - float(taken.sum())
    explained = float(layout.fold(sums.right)[:, 0] @ found.folded[:, 0]) + float(
        sums.free_right @ found.free
    )
    residual = max(sums.square - explained - float(bending.sum()), 1e-12 * sums.square)
    return SplineFit(
        layout=layout,
        coefficients=np.ascontiguousarray(coefficients[:, :, 0]),
        free=found.free,
        scale=residual / max(sums.count - dimensions, 1.0),
        strength=strength,
        bending=bending,
        taken=taken,
        factor=found.factor,
        cross=found.cross,
        schur=found.schur,
    )


def _correction(penalty: Penalty, bent: Floats, schur: Floats) -> Floats:
    """What the free columns, `bent` (p, q, e) by the spline, add to the traces of the spline's inverse."""
    e = bent.shape[2]
    flat = np.linalg.solve(schur, bent.reshape(-1, e).T)
    return (penalty.times(bent).reshape(-1, bent.size // e, e) * flat.T).sum(axis=(1, 2))


def fit_spline(sums: Sums, penalty: Penalty, start: Floats, rounds: int = 12) -> SplineFit:
    """The fit at the strengths of restricted maximum likelihood, from the strengths `start`.

    Source: the generalised Fellner-Schall update, Wood and Fasiolo 2017, equation 4.
    """
    fit = solve(sums, penalty, start)
    for _ in range(rounds):
        gain = np.clip(penalty.effective(fit.strength) - fit.taken, 1e-6, None)
        step = np.clip(np.log(fit.scale * gain / np.maximum(fit.bending, 1e-300)), -4.0, 4.0)
        strength = np.clip(fit.strength * np.exp(_OVERSTEP * step), start * 1e-6, start * 1e9)
        fit = solve(sums, penalty, strength)
        if np.abs(step).max() < 0.3:
            break
    return fit
