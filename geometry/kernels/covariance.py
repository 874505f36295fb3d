"""Covariance of the displacement along the normal between places on a part: smooth wear and ripple.

`places` (n, 3) lie in axes of which the last runs along the span; `swell` (n,) is how much of the swelling a
place feels. `prior` holds, in this order, the standard deviations of the shift and of the swelling, their
correlation lengths along the span and in the section, and the standard deviation and length of the ripple.
"""

import numpy as np
from numba import njit

from geometry.types import Floats

TURN = 0.75  # length of a difference of unit normals over which ripples are no longer alike
FAR = 8.0  # lengths beyond which ripples have nothing in common: 1e-5


@njit(cache=True, nogil=True, inline="always")
def _smooth(r2):  # type: ignore[no-untyped-def]
    """Matern correlation of smoothness 5/2 at the squared distance in lengths."""
    a = np.sqrt(5.0 * r2)
    return (1.0 + a + a * a / 3.0) * np.exp(-a)


@njit(cache=True, nogil=True, inline="always")
def _between(places, normals, i, others, other_normals, j):  # type: ignore[no-untyped-def]
    """Squared distances in the section and along the span, and of the normals; product of the normals, and
    what an affine motion within the section has in common at both places."""
    across, turned, together, aligned = 0.0, 0.0, 0.0, 0.0
    for axis in range(2):
        across += (places[i, axis] - others[j, axis]) ** 2
        together += normals[i, axis] * other_normals[j, axis]
    for axis in range(3):
        turned += (normals[i, axis] - other_normals[j, axis]) ** 2
        aligned += places[i, axis] * others[j, axis]
    aligned *= together
    together += normals[i, 2] * other_normals[j, 2]
    return across, (places[i, 2] - others[j, 2]) ** 2, turned, together, aligned


@njit(cache=True, nogil=True)
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
    per_span2, per_section2 = 1.0 / prior[2] ** 2, 1.0 / prior[3] ** 2
    for i in range(len(places)):
        for j in range(len(others)):
            across, along, _, together, aligned = _between(places, normals, i, others, other_normals, j)
            alike = _smooth(along * per_span2 + across * per_section2)
            value = (affine[0] ** 2 + prior[0] ** 2 * alike) * together + affine[1] ** 2 * aligned
            result[i, j] = value + prior[1] ** 2 * alike * swell[i] * other_swell[j]
    return result


@njit(cache=True, nogil=True)
def joint_covariance(
    places: Floats, normals: Floats, swell: Floats, prior: Floats, affine: Floats, noise: Floats
) -> Floats:
    """The upper triangle (n, n) of the covariance of displacements with their ripple and noise variance (n,);
    zero below."""
    result = np.zeros((len(places), len(places)))
    per_span2, per_section2 = 1.0 / prior[2] ** 2, 1.0 / prior[3] ** 2
    per_ripple2, far2 = 3.0 / prior[5] ** 2, (FAR * prior[5]) ** 2
    for i in range(len(places)):
        for j in range(i, len(places)):
            across, along, turned, together, aligned = _between(places, normals, i, places, normals, j)
            alike = _smooth(along * per_span2 + across * per_section2)
            value = (affine[0] ** 2 + prior[0] ** 2 * alike) * together + affine[1] ** 2 * aligned
            value += prior[1] ** 2 * alike * swell[i] * swell[j]
            if across + along < far2:
                b = np.sqrt((across + along) * per_ripple2)
                value += prior[4] ** 2 * (1.0 + b) * np.exp(-b - 0.5 * turned / TURN**2)
            result[i, j] = value
        result[i, i] += noise[i]
    return result


@njit(cache=True, nogil=True)
def covariance_slopes(
    places: Floats, normals: Floats, swell: Floats, prior: Floats, weights: Floats
) -> Floats:
    """The sums (6,) of `weights` (n, n), symmetric, times the derivatives of the joint covariance by the
    logarithms of the prior's six numbers. The upper triangle of the weights is read."""
    sums = np.zeros(6)
    per_span2, per_section2 = 1.0 / prior[2] ** 2, 1.0 / prior[3] ** 2
    per_ripple2, far2 = 3.0 / prior[5] ** 2, (FAR * prior[5]) ** 2
    for i in range(len(places)):
        for j in range(i, len(places)):
            twice = weights[i, j] * (1.0 if i == j else 2.0)
            across, along, turned, together, _ = _between(places, normals, i, places, normals, j)
            along_r2, across_r2 = along * per_span2, across * per_section2
            a = np.sqrt(5.0 * (along_r2 + across_r2))
            falling = np.exp(-a)
            alike = (1.0 + a + a * a / 3.0) * falling
            shift, swelling = prior[0] ** 2 * together, prior[1] ** 2 * swell[i] * swell[j]
            falls = (shift + swelling) * (5.0 / 3.0) * (1.0 + a) * falling
            sums[0] += twice * 2.0 * shift * alike
            sums[1] += twice * 2.0 * swelling * alike
            sums[2] += twice * falls * along_r2
            sums[3] += twice * falls * across_r2
            if across + along < far2:
                b = np.sqrt((across + along) * per_ripple2)
                ripple = prior[4] ** 2 * np.exp(-b - 0.5 * turned / TURN**2)
                sums[4] += twice * 2.0 * ripple * (1.0 + b)
                sums[5] += twice * ripple * b * b
    return sums


@njit(cache=True, nogil=True)
def carried(places: Floats, others: Floats, prior: Floats, sources: Floats) -> Floats:
    """The sums (n, 4) of `sources` (m, 4) of the other places, weighted by the correlation of smooth wear."""
    result = np.empty((len(places), 4))
    scale = 1.0 / np.array([prior[3], prior[3], prior[2]])
    here, there = places * scale, others * scale
    for i in range(len(places)):
        x, y, z = here[i]
        a, b, c, d = 0.0, 0.0, 0.0, 0.0
        for j in range(len(others)):
            alike = _smooth((x - there[j, 0]) ** 2 + (y - there[j, 1]) ** 2 + (z - there[j, 2]) ** 2)
            a += alike * sources[j, 0]
            b += alike * sources[j, 1]
            c += alike * sources[j, 2]
            d += alike * sources[j, 3]
        result[i, 0], result[i, 1], result[i, 2], result[i, 3] = a, b, c, d
    return result
