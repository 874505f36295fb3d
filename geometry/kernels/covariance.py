"""Covariance of the displacement along the normal between places on a part: smooth wear and ripple.

`places` (n, 3) lie in axes of which the last runs along the span; `swell` (n,) is how much of the swelling a
place feels. `prior` holds, in this order, the standard deviations of the shift and of the swelling, their
correlation lengths along the span and in the section, and the standard deviation and length of the ripple.
Wear runs round a section much alike all along the span: its correlation is a product of both.

Inner loops run along columns, without branches: compilers make vectors of them.
"""

import numpy as np
from numba import njit

from geometry.kernels.decay import decay
from geometry.types import Floats

TURN = 0.75  # length of a difference of unit normals over which ripples are no longer alike
SUMS = {"reassoc", "contract", "nsz"}  # freedom to add up in another order, as vectors do


@njit(cache=True, nogil=True)
def _columns(places: Floats, normals: Floats, swell: Floats) -> Floats:
    """Places, normals and swell of each in a table (7, n)."""
    table = np.empty((7, len(places)))
    table[:3], table[3:6], table[6] = places.T, normals.T, swell
    return table


@njit(cache=True, nogil=True, inline="always")
def _place(table, i):  # type: ignore[no-untyped-def]
    """Column i as numbers: read in the loop, they could have changed with what it writes."""
    return table[0, i], table[1, i], table[2, i], table[3, i], table[4, i], table[5, i], table[6, i]


@njit(cache=True, nogil=True, inline="always")
def _alike(along_r2, across_r2):  # type: ignore[no-untyped-def]
    """Matern correlations of smoothness 5/2 at squared distances in lengths, along the span times in the
    section."""
    a, b = np.sqrt(5.0 * along_r2), np.sqrt(5.0 * across_r2)
    return (1.0 + a + a * a / 3.0) * (1.0 + b + b * b / 3.0) * decay(a + b)


@njit(cache=True, nogil=True, fastmath=SUMS)
def _between(
    x: float, y: float, z: float, nx: float, ny: float, nz: float, there: Floats, j: int
) -> tuple[float, float, float, float, float]:
    """Squared distances in the section and along the span, and of the normals; product of the normals, and
    what an affine motion within the section has in common at both places: of one place and column j."""
    across = (x - there[0, j]) ** 2 + (y - there[1, j]) ** 2
    along = (z - there[2, j]) ** 2
    turned = (nx - there[3, j]) ** 2 + (ny - there[4, j]) ** 2 + (nz - there[5, j]) ** 2
    together = nx * there[3, j] + ny * there[4, j]
    aligned = (x * there[0, j] + y * there[1, j] + z * there[2, j]) * together
    return across, along, turned, together + nz * there[5, j], aligned


@njit(cache=True, nogil=True, fastmath=SUMS)
def covariance(
    places: Floats,
    normals: Floats,
    swell: Floats,
    others: Floats,
    other_normals: Floats,
    other_swell: Floats,
    prior: Floats,
    affine: Floats,
) -> Floats:
    """The covariance (n, m) of wear without ripple; all places share a motion of which `affine` (2,) holds
    the standard deviations: of its shift at the origin, and of the change of its part in the section."""
    result = np.empty((len(places), len(others)))
    here, there = _columns(places, normals, swell), _columns(others, other_normals, other_swell)
    per_span2, per_section2 = 1.0 / prior[2] ** 2, 1.0 / prior[3] ** 2
    moved2, leaned2, shift2, swelling2 = affine[0] ** 2, affine[1] ** 2, prior[0] ** 2, prior[1] ** 2
    for i in range(len(places)):
        x, y, z, nx, ny, nz, swells = _place(here, i)
        for j in range(len(others)):
            across, along, _, together, aligned = _between(x, y, z, nx, ny, nz, there, j)
            alike = _alike(along * per_span2, across * per_section2)
            value = (moved2 + shift2 * alike) * together + leaned2 * aligned
            result[i, j] = value + swelling2 * alike * swells * there[6, j]
    return result


@njit(cache=True, nogil=True, fastmath=SUMS)
def joint_covariance(
    places: Floats, normals: Floats, swell: Floats, prior: Floats, affine: Floats, noise: Floats
) -> Floats:
    """The upper triangle (n, n) of the covariance of displacements with their ripple and noise variance (n,);
    zero below."""
    result = np.zeros((len(places), len(places)))
    table = _columns(places, normals, swell)
    per_span2, per_section2, per_ripple2 = 1.0 / prior[2] ** 2, 1.0 / prior[3] ** 2, 3.0 / prior[5] ** 2
    moved2, leaned2, shift2, swelling2 = affine[0] ** 2, affine[1] ** 2, prior[0] ** 2, prior[1] ** 2
    ripple2, per_turn2 = prior[4] ** 2, 0.5 / TURN**2
    for i in range(len(places)):
        x, y, z, nx, ny, nz, swells = _place(table, i)
        for j in range(i, len(places)):
            across, along, turned, together, aligned = _between(x, y, z, nx, ny, nz, table, j)
            alike = _alike(along * per_span2, across * per_section2)
            b = np.sqrt((across + along) * per_ripple2)
            value = (moved2 + shift2 * alike) * together + leaned2 * aligned
            value += swelling2 * alike * swells * table[6, j]
            result[i, j] = value + ripple2 * (1.0 + b) * decay(b + turned * per_turn2)
        result[i, i] += noise[i]
    return result


@njit(cache=True, nogil=True, fastmath=SUMS)
def covariance_slopes(
    places: Floats, normals: Floats, swell: Floats, prior: Floats, weights: Floats
) -> Floats:
    """The sums (6,) of `weights` (n, n), symmetric, times the derivatives of the joint covariance by the
    logarithms of the prior's six numbers. The upper triangle of the weights is read."""
    table = _columns(places, normals, swell)
    per_span2, per_section2, per_ripple2 = 1.0 / prior[2] ** 2, 1.0 / prior[3] ** 2, 3.0 / prior[5] ** 2
    shift2, swelling2, ripple2, per_turn2 = prior[0] ** 2, prior[1] ** 2, prior[4] ** 2, 0.5 / TURN**2
    shifts, swellings, spans, sections, ripples, lengths = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(places)):
        x, y, z, nx, ny, nz, swells = _place(table, i)
        shifts += weights[i, i] * shift2 * (nx**2 + ny**2 + nz**2)
        swellings += weights[i, i] * swelling2 * swells**2
        ripples += weights[i, i] * ripple2
        for j in range(i + 1, len(places)):
            across, along, turned, together, _ = _between(x, y, z, nx, ny, nz, table, j)
            along_r2, across_r2 = along * per_span2, across * per_section2
            a, b = np.sqrt(5.0 * along_r2), np.sqrt(5.0 * across_r2)
            alike_along, alike_across = 1.0 + a + a * a / 3.0, 1.0 + b + b * b / 3.0
            falling = weights[i, j] * decay(a + b)
            shift, swelling = shift2 * together * falling, swelling2 * swells * table[6, j] * falling
            falls = (shift + swelling) * (5.0 / 3.0)
            shifts += 2.0 * shift * alike_along * alike_across
            swellings += 2.0 * swelling * alike_along * alike_across
            spans += falls * along_r2 * (1.0 + a) * alike_across
            sections += falls * across_r2 * (1.0 + b) * alike_along
            c = np.sqrt((across + along) * per_ripple2)
            ripple = weights[i, j] * ripple2 * decay(c + turned * per_turn2)
            ripples += 2.0 * ripple * (1.0 + c)
            lengths += ripple * c * c
    return 2.0 * np.array([shifts, swellings, spans, sections, ripples, lengths])


@njit(cache=True, nogil=True, fastmath=SUMS)
def carried(places: Floats, others: Floats, prior: Floats, sources: Floats) -> Floats:
    """The sums (n, 4) of `sources` (m, 4) of the other places, weighted by the correlation of smooth wear."""
    result = np.empty((len(places), 4))
    scale = 1.0 / np.array([prior[3], prior[3], prior[2]])
    here, there = places * scale, np.ascontiguousarray((others * scale).T)
    columns = np.ascontiguousarray(sources.T)
    for i in range(len(places)):
        x, y, z = here[i]
        a, b, c, d = 0.0, 0.0, 0.0, 0.0
        for j in range(len(others)):
            alike = _alike((z - there[2, j]) ** 2, (x - there[0, j]) ** 2 + (y - there[1, j]) ** 2)
            a += alike * columns[0, j]
            b += alike * columns[1, j]
            c += alike * columns[2, j]
            d += alike * columns[3, j]
        result[i, 0], result[i, 1], result[i, 2], result[i, 3] = a, b, c, d
    return result
