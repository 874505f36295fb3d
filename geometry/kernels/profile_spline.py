"""A penalised cubic tensor spline, periodic by open, whose smoothness its own data decide."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.linalg.lapack import dtbtrs

from geometry.kernels.tensor_spline import band_inverse, bend_times, tensor_sums, tensor_values
from geometry.types import Floats, Ints

_BALANCED = 0.25  # dimensions: twice the gain in log likelihood by an e-fold of strength
_WEAKER, _STRONGER = np.log(1e4), np.log(2e2)  # reach of the search for the strengths


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
    along: Floats  # (groups, p, 4): [i, d] against i + d; no bend reaches farther than 2
    share: Floats  # (p,)
    across: Floats  # (q, q)
    nu: Floats  # (q,) eigenvalues of `across`

    def matrix(self, strength: Floats) -> Floats:
        """The sum of the matrices, each times its strength, as a stencil matrix."""
        total = np.tensordot(strength[:-1], self.along, 1)
        out: Floats = total[:, :, None, None] * np.eye(self.layout.q)
        out[:, 0] += strength[-1] * self.share[:, None, None] * self.across
        return out

    def times(self, values: Floats) -> Floats:
        """Every matrix times values (p, q, n): (matrices, p, q, n)."""
        along = bend_times(self.along, np.ascontiguousarray(values).reshape(len(values), -1))
        share = self.share[:, None, None] * (self.across @ values)
        return np.concatenate([along.reshape(-1, *values.shape), share[None]])

    def traces(self, inverse: Floats) -> Floats:
        """Trace of every matrix times an inverse, given where stencil matrices have entries."""
        blocks = np.trace(inverse, axis1=2, axis2=3) * _TWICE
        across = float((self.share @ inverse[:, 0].reshape(self.layout.p, -1)) @ self.across.ravel())
        return np.append((self.along * blocks).sum(axis=(1, 2)), across)

    def effective(self, strength: Floats) -> Floats:
        """Strength times trace(S^- S_j) for each matrix S_j of the sum S: the dimensions it penalises.

        Seen in the eigenvectors of `across`, S falls into q matrices along, the first two of which bend
        with the arc only: constants are all that these leave free, and one coefficient is held for them.
        """
        layout, nu = stencil(self.layout.p, 1), strength[-1] * self.nu
        along = np.tensordot(strength[:-1], self.along, 1)
        blocks = np.repeat(along[None], len(nu), axis=0)
        blocks[:, :, 0] += nu[:, None] * self.share
        blocks[:2, 0, 0] += along[:, 0].max()
        bands = np.hstack([layout.band(block[:, :, None, None]) for block in blocks])
        inverse = band_inverse(cholesky_banded(bands, lower=True, check_finite=False))
        inside = np.stack([layout.inside(each)[:, :, 0, 0] for each in np.split(inverse, len(nu), axis=1)])
        parts = (self.along * (inside.sum(axis=0) * _TWICE)).sum(axis=(1, 2))
        return np.append(strength[:-1] * parts, float((nu @ inside[:, :, 0]) @ self.share))


_TWICE = np.array([1.0, 2.0, 2.0, 2.0])  # what is off the diagonal is there twice


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
    weights = open_mm * share * (group == np.arange(int(group.max()) + 1)[:, None])
    i, d = np.ix_(here, np.arange(4))
    across = open_mm * second.T @ second
    return Penalty(
        layout=stencil(p, q),
        along=np.stack([(rows.T @ (rows * weight[:, None]))[i, (i + d) % p] for weight in weights]),
        share=share,
        across=across,
        nu=np.concatenate([[0.0, 0.0], np.linalg.eigvalsh(across)[2:]]),
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
    solved: Floats  # (p q, e): the inverse of the spline's matrix times `cross`
    schur: Floats  # (e, e)
    inverse: Floats  # (p, 4, q, q) of the spline's matrix, where a stencil has entries

    def values(self, u: Floats, v: Floats, columns: Floats) -> Floats:
        """The fitted function at (u, v)."""
        return tensor_values(u, v, self.coefficients) + columns @ self.free

    def covariance(self, spline: Floats, free: Floats) -> Floats:
        """Covariance (n, n) of n linear functions: weights `spline` (p, q, n) and `free` (e, n)."""
        folded = self.layout.fold(spline)
        half = dtbtrs(self.factor, folded, uplo="L")[0]
        rest = self._padded(free) - self.solved.T @ folded
        return self.scale * (half.T @ half + rest.T @ np.linalg.solve(self.schur, rest))

    def variances(self, first: Ints, along: Floats, across: Floats, free: Floats) -> Floats:
        """Variance (n,) of n values of the function, at less cost: `along` (n, 4) weights the rows of
        coefficients from `first` (n,) on, `across` (q,) those in a row, `free` (e, n) the free columns."""
        row = (first[:, None] + np.arange(4)) % self.layout.p
        inside = (self.inverse @ across) @ across
        own = np.zeros(len(first))
        for k in range(4):
            for d in range(4 - k):
                own += _TWICE[d] * along[:, k] * along[:, k + d] * inside[row[:, k], d]
        bent = across @ self.layout.unfold(self.solved)
        rest = self._padded(free).T - sum(along[:, k, None] * bent[row[:, k]] for k in range(4))
        variances: Floats = self.scale * (own + ((rest @ np.linalg.inv(self.schur)) * rest).sum(axis=1))
        return variances

    def _padded(self, free: Floats) -> Floats:
        """Weights of the free columns, none for the functions held."""
        return np.vstack([free, np.zeros((self.cross.shape[1] - len(free), free.shape[1]))])

    def held(self, weights: Floats, variance: Floats) -> "SplineFit":
        """The fit, told that the functions `weights` (p, q, n) of the spline are 0 with a `variance` (n,).

        As if each had been measured to be 0 (conditioning of a Gaussian posterior): the multipliers of these
        measurements join the free columns.
        """
        folded, old = self.layout.fold(weights), self.cross.shape[1]
        bent = cho_solve_banded((self.factor, True), folded, check_finite=False)
        cross, solved = np.hstack([self.cross, folded]), np.hstack([self.solved, bent])
        schur = -cross.T @ solved
        schur[:old, :old] = self.schur
        schur[old:, old:] -= np.diag(variance / self.scale)
        before = self.layout.fold(self.coefficients[:, :, None])[:, 0]
        wrong = np.concatenate([np.zeros(old), -(folded.T @ before)])
        step = np.linalg.solve(schur, wrong)
        after = self.layout.unfold((before - solved @ step)[:, None])[:, :, 0]
        free = self.free + step[: len(self.free)]
        return replace(
            self,
            coefficients=np.ascontiguousarray(after),
            free=free,
            cross=cross,
            solved=solved,
            schur=schur,
        )


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
        solved=found.solved[:, 1:],
        schur=found.schur,
        inverse=inverse,
    )


def _correction(penalty: Penalty, bent: Floats, schur: Floats) -> Floats:
    """What the free columns, `bent` (p, q, e) by the spline, add to the traces of the spline's inverse."""
    e = bent.shape[2]
    flat = np.linalg.solve(schur, bent.reshape(-1, e).T)
    return (penalty.times(bent).reshape(-1, bent.size // e, e) * flat.T).sum(axis=(1, 2))


def fit_spline(sums: Sums, penalty: Penalty, start: Floats, rounds: int = 12) -> SplineFit:
    """The fit at the strengths of restricted maximum likelihood, from the strengths `start`.

    A strength is in balance when the dimensions that it is left to penalise equal the bending found, in
    units of the noise: then the likelihood no longer grows with it. The logarithms of their ratios are
    brought to zero by Broyden's method, from a guess of its slopes; a form without any bending ends at
    the strongest that is tried.
    Source: the generalised Fellner-Schall update, Wood and Fasiolo 2017, equation 4.
    """
    low, high = np.log(start) - _WEAKER, np.log(start) + _STRONGER
    log, slopes = np.log(start), _guess(len(start))
    last: tuple[Floats, Floats] | None = None
    fit = solve(sums, penalty, start)
    for _ in range(rounds):
        owed = np.maximum(penalty.effective(fit.strength) - fit.taken, 1e-6)
        found = np.maximum(fit.bending / fit.scale, 1e-6)
        ratio = np.log(owed / found)
        free = np.where(ratio > 0.0, log < high, log > low)
        if not (np.abs(owed - found)[free] > _BALANCED).any():
            break
        if last is not None:
            before, moved = last
            if moved.any():
                slopes = slopes + np.outer(ratio - before - slopes @ moved, moved) / float(moved @ moved)
            else:  # every strength stayed at the end of its range
                slopes = _guess(len(start))
        step = -np.linalg.solve(slopes, ratio)
        if not (step @ ratio > 0.0 and np.abs(step).max() <= 4.0 * np.abs(ratio).max()):
            slopes = _guess(len(start))
            step = -np.linalg.solve(slopes, ratio)
        after = np.clip(log + np.clip(step, -3.0, 3.0), low, high)
        last, log = (ratio, after - log), after
        fit = solve(sums, penalty, np.exp(log))
    return fit


def _guess(count: int) -> Floats:
    """How the logarithms of the ratios fall with those of the strengths, as blades have it; slowly across."""
    return np.diag(np.append(np.full(count - 1, -0.8), -0.3))
