"""Sums, values and inverses of the tensor spline through the points of a band."""

import numpy as np
from numba import njit

from geometry.kernels.profile import wrap
from geometry.types import Floats, Ints


@njit(cache=True, nogil=True)
def _cubic(f: float, b: Floats) -> None:
    """The four uniform cubic B-splines at the fraction `f` of a knot span."""
    g = 1.0 - f
    b[0] = g * g * g / 6.0
    b[1] = (3.0 * f * f * f - 6.0 * f * f + 4.0) / 6.0
    b[2] = (-3.0 * f * f * f + 3.0 * f * f + 3.0 * f + 1.0) / 6.0
    b[3] = f * f * f / 6.0


@njit(cache=True, nogil=True)
def _add_span(
    i0: int, k0: int, pairs: Floats, terms: Floats, gram: Floats, right: Floats, cross: Floats
) -> None:
    """Adds what the data of one knot span gave (see `tensor_sums`), and clears it."""
    p = len(right)
    one = 0
    for a in range(4):
        i = wrap(i0 + a, p)
        for d in range(4 - a):
            other = 0
            for k in range(4):
                for m in range(k, 4):
                    gram[i, d, k0 + k, k0 + m] += pairs[one, other]
                    if m > k:
                        gram[i, d, k0 + m, k0 + k] += pairs[one, other]
                    other += 1
            one += 1
        for k in range(4):
            right[i, k0 + k] += terms[4 * a + k, 0]
            cross[i, k0 + k] += terms[4 * a + k, 1:]
    pairs[:] = 0.0
    terms[:] = 0.0


@njit(cache=True, nogil=True)
def tensor_sums(
    u: Floats, v: Floats, y: Floats, weight: Floats, extra: Floats, shape: tuple[int, int]
) -> tuple[Floats, Floats, Floats]:
    """Weighted sums of a periodic-by-open cubic tensor spline with `extra` plain columns.

    `u` in knot spans of the periodic direction, `v` in knot spans from the first one of the open one,
    `shape` the numbers of coefficients (p, q). Gives `gram` (p, 4, q, q): sum of the products of the
    coefficients (i, k) and (i + d, l); `right` (p, q): against `y`; `cross` (p, q, e): against `extra`.
    Data that follow one another in a knot span are summed before they are added to these.
    """
    p, q = shape
    e = extra.shape[1]
    gram, right, cross = np.zeros((p, 4, q, q)), np.zeros((p, q)), np.zeros((p, q, e))
    bu, bv, both = np.empty(4), np.empty(4), np.empty(10)
    pairs, terms = np.zeros((10, 10)), np.zeros((16, e + 1))  # of two splines each way; of one and a column
    i, j = 0, 0
    for n in range(len(u)):
        if weight[n] == 0.0:
            continue
        i0, k0 = int(u[n]), min(max(int(v[n]), 0), q - 4)
        if i0 != i or k0 != j:
            _add_span(i, j, pairs, terms, gram, right, cross)
            i, j = i0, k0
        _cubic(u[n] - i0, bu)
        _cubic(v[n] - k0, bv)
        other = 0
        for k in range(4):
            for m in range(k, 4):
                both[other] = bv[k] * bv[m]
                other += 1
        one = 0
        for a in range(4):
            wa = weight[n] * bu[a]
            for b in range(a, 4):
                wab = wa * bu[b]
                for c in range(10):
                    pairs[one, c] += wab * both[c]
                one += 1
            for k in range(4):
                wak = wa * bv[k]
                terms[4 * a + k, 0] += wak * y[n]
                for c in range(e):
                    terms[4 * a + k, c + 1] += wak * extra[n, c]
    _add_span(i, j, pairs, terms, gram, right, cross)
    return gram, right, cross


@njit(cache=True, nogil=True)
def tensor_values(u: Floats, v: Floats, coefficients: Floats) -> Floats:
    """The tensor spline of `tensor_sums` at (u, v): (n,)."""
    p, q = coefficients.shape
    out = np.empty(len(u))
    bu = np.empty(4)
    bv = np.empty(4)
    for n in range(len(u)):
        i0 = int(u[n])
        k0 = min(max(int(v[n]), 0), q - 4)
        _cubic(u[n] - i0, bu)
        _cubic(v[n] - k0, bv)
        value = 0.0
        for a in range(4):
            for k in range(4):
                value += bu[a] * bv[k] * coefficients[wrap(i0 + a, p), k0 + k]
        out[n] = value
    return out


@njit(cache=True, nogil=True)
def band_inverse(factor: Floats) -> Floats:
    """The entries of `(L L')^-1` inside the band of `L`, in the same lower band storage (w + 1, n).

    `factor[d, j]` is L[j + d, j], as `scipy.linalg.cholesky_banded(lower=True)` gives it.
    Source: Takahashi, Fagan and Chin 1973, the recursion from the last column to the first. The part of
    the inverse that a column needs is kept square, row k in place k modulo w.
    """
    width, n = factor.shape
    ring = max(width - 1, 1)
    lower = np.ascontiguousarray(factor.T)
    inverse = np.zeros((n, width))
    near, pull = np.zeros((ring, ring)), np.empty(ring)
    for j in range(n - 1, -1, -1):
        reach, own = min(width - 1, n - 1 - j), 1.0 / lower[j, 0]
        pull[:] = 0.0
        for d in range(1, reach + 1):
            row, f = near[(j + d) % ring], lower[j, d]
            for k in range(ring):
                pull[k] += f * row[k]
        total = 0.0
        for d in range(1, reach + 1):
            inverse[j, d] = -own * pull[(j + d) % ring]
            total += lower[j, d] * inverse[j, d]
        inverse[j, 0] = own * (own - total)
        here = j % ring
        for d in range(reach, -1, -1):
            there = (j + d) % ring
            near[here, there] = near[there, here] = inverse[j, d]
    return inverse.T


@njit(cache=True, nogil=True)
def cubic_weights(t: Floats, first: Ints) -> Floats:
    """The four cubic B-splines (n, 4) of the knot span `first` (n,) at `t` (n,), in knot spans."""
    out = np.empty((len(t), 4))
    for n in range(len(t)):
        _cubic(t[n] - first[n], out[n])
    return out


@njit(cache=True, nogil=True)
def _columns(arm: Floats, normal: Floats, height: float, out: Floats) -> None:
    """Growth (6,) of a distance with the shift x, y and turn of a section, and with their slopes."""
    out[0], out[1] = normal[0], normal[1]
    out[2] = normal[1] * arm[0] - normal[0] * arm[1]
    for c in range(3):
        out[3 + c] = out[c] * height


@njit(cache=True, nogil=True)
def band_misfit(u: Floats, v: Floats, rows: Floats, coefficients: Floats, free: Floats) -> Floats:
    """Signed distance (n,) of points from a tensor spline with the rigid columns `free` (6,).

    `rows` (n, 6): distance, arm x, y, normal x, y, height; `u`, `v` as in `tensor_sums`.
    """
    p, q = coefficients.shape
    out = np.empty(len(u))
    bu, bv, columns = np.empty(4), np.empty(4), np.empty(6)
    for n in range(len(u)):
        i0 = int(u[n])
        k0 = min(max(int(v[n]), 0), q - 4)
        _cubic(u[n] - i0, bu)
        _cubic(v[n] - k0, bv)
        _columns(rows[n, 1:3], rows[n, 3:5], rows[n, 5], columns)
        value = 0.0
        for c in range(6):
            value += columns[c] * free[c]
        for a in range(4):
            i = wrap(i0 + a, p)
            for k in range(4):
                value += bu[a] * bv[k] * coefficients[i, k0 + k]
        out[n] = rows[n, 0] - value
    return out


@njit(cache=True, nogil=True)
def band_bins(
    u: Floats, v: Floats, rows: Floats, weight: Floats, shape: tuple[int, int], per_span: tuple[int, int]
) -> Floats:
    """Weighted means (k, 10) of the points in each bin that has any: u, v, weight, distance, six columns.

    `shape` (p, spans) of the spline, `per_span` bins in each knot span; `rows` as in `band_misfit`. What a
    bin blurs is of second order: half the spline's curvature times the variance of places in a bin.
    """
    across = shape[1] * per_span[1]
    sums = np.zeros((shape[0] * per_span[0] * across, 10))
    columns = np.empty(6)
    for n in range(len(u)):
        w = weight[n]
        if w == 0.0:
            continue
        _columns(rows[n, 1:3], rows[n, 3:5], rows[n, 5], columns)
        b = int(u[n] * per_span[0]) * across + min(max(int(v[n] * per_span[1]), 0), across - 1)
        sums[b, 0] += w * u[n]
        sums[b, 1] += w * v[n]
        sums[b, 2] += w
        sums[b, 3] += w * rows[n, 0]
        for c in range(6):
            sums[b, 4 + c] += w * columns[c]
    used = 0
    for b in range(len(sums)):
        total = sums[b, 2]
        if total > 0.0:
            for c in range(10):
                sums[used, c] = sums[b, c] if c == 2 else sums[b, c] / total
            used += 1
    return sums[:used].copy()


@njit(cache=True, nogil=True)
def bend_times(along: Floats, values: Floats) -> Floats:
    """Symmetric periodic matrices (g, p, 4), [i, d] against i + d, none at 3, times (p, k): (g, p, k)."""
    groups, p, _ = along.shape
    out = np.zeros((groups, p, values.shape[1]))
    for g in range(groups):
        for i in range(p):
            for d in range(3):
                w = along[g, i, d]
                if w == 0.0:
                    continue
                j = wrap(i + d, p)
                for k in range(values.shape[1]):
                    out[g, i, k] += w * values[j, k]
                    if d > 0:
                        out[g, j, k] += w * values[i, k]
    return out
