"""Smooth wear from scattered displacements: the most probable field, its certainty, and its own prior.

Wear is a Gaussian field over space that shifts the metal and swells it along its normals; what it leaves is
ripple, alike over a few millimetres, and noise. How far wear reaches along the span and in the section, and
how large all of it is, the displacements themselves tell; so it runs on over lost metal as it runs elsewhere.
Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, chapters 2 and 5.
"""

from dataclasses import dataclass, fields

import numpy as np
from scipy.linalg import LinAlgError, cho_solve, cholesky, solve_triangular
from scipy.linalg.lapack import dpotri
from scipy.optimize import minimize

from geometry.deformation.freeform import Freeform, Lattice, swell
from geometry.errors import CannotFitTwin
from geometry.kernels.covariance import carried, covariance, covariance_slopes, joint_covariance
from geometry.types import Floats, Ints

AFFINE = np.array([0.3, 0.005])  # mm, mm/mm: so much the pose may be off where little holds it, and lean
VAGUE = np.array([3.0, 3.0, 2.0, 2.0, 3.0, 1.0])  # standard deviations of the logarithms before the data
TYPICAL_MM = (0.05, 0.05, 0.003)  # shift, swelling, ripple
SECTION_SHARE = 0.45  # of the section's extent: over so much wear is alike
RIPPLE_CELLS = 0.65  # over so much ripple is alike
SHORTEST_CELLS, LONGEST_EXTENTS = 1.75, 4.0  # bounds of the lengths of wear
STEPS = 12  # of the search for the prior, at most
SLOPE_STEP = 1e-3  # of the logarithms, between the slopes whose difference is the curvature
LOOSEST = 1.0  # of the logarithms: a rival prior is no farther off


@dataclass(frozen=True, slots=True, kw_only=True)
class Prior:
    """What is known of wear before it is seen: standard deviations and lengths over which it is alike."""

    shift_mm: float
    swelling_mm: float
    span_mm: float  # length along the span
    section_mm: float  # and in the section
    ripple_mm: float
    ripple_length_mm: float

    @property
    def numbers(self) -> Floats:
        """All six (6,), as the kernels take them."""
        return np.array([getattr(self, each.name) for each in fields(self)])

    @classmethod
    def of(cls, numbers: Floats) -> "Prior":
        """The prior with these six numbers (6,)."""
        names = (each.name for each in fields(cls))
        return cls(**{name: float(number) for name, number in zip(names, numbers, strict=True)})


def typical_prior(lattice: Lattice) -> Prior:
    """The prior for an airfoil of which nothing was seen yet."""
    length_mm = SECTION_SHARE * _extents_mm(lattice)[0]
    shift_mm, swelling_mm, ripple_mm = TYPICAL_MM
    return Prior(
        shift_mm=shift_mm,
        swelling_mm=swelling_mm,
        span_mm=length_mm,
        section_mm=length_mm,
        ripple_mm=ripple_mm,
        ripple_length_mm=RIPPLE_CELLS * lattice.cell_mm,
    )


def _extents_mm(lattice: Lattice) -> tuple[float, float]:
    """Of the lattice in the section and along the span."""
    spans = (lattice.counts - 3) * lattice.cell_mm
    return float(spans[1]), float(spans[2])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sample:
    """Displacements of an airfoil's surface along its normals at scattered places."""

    places_mm: Floats  # (n, 3) in the axes of the lattice
    normals: Floats  # (n, 3) in the same axes
    swell: Floats  # (n,)
    value_mm: Floats  # (n,)
    variance_mm2: Floats  # (n,) of the value's noise

    def thinned(self, most: int) -> "Sample":
        """About `most` of the places, at most."""
        count = len(self.value_mm)
        return self.only(np.arange(0, count, max(1, -(-count // most))))

    def only(self, chosen: Ints) -> "Sample":
        """The chosen places."""
        return Sample(
            places_mm=self.places_mm[chosen],
            normals=self.normals[chosen],
            swell=self.swell[chosen],
            value_mm=self.value_mm[chosen],
            variance_mm2=self.variance_mm2[chosen],
        )


def sample_of(
    lattice: Lattice, points_mm: Floats, normals: Floats, value_mm: Floats, variance_mm2: Floats
) -> Sample:
    """The sample of displacements (n,) at points (n, 3) with normals (n, 3) of the nominal frame."""
    return Sample(
        places_mm=lattice.own(points_mm),
        normals=lattice.own(normals),
        swell=swell(normals),
        value_mm=value_mm,
        variance_mm2=variance_mm2,
    )


def likeliest_prior(sample: Sample, start: Prior, lattice: Lattice, most: int) -> Prior:
    """The prior under which about `most` of the displacements are the most probable, sought from `start`."""
    few, typical = sample.thinned(most), np.log(typical_prior(lattice).numbers)
    bounds = _bounds(lattice, typical)
    found = minimize(
        lambda logs: _unlikely(few, logs, typical),
        np.log(start.numbers),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"maxiter": STEPS},
    )
    return Prior.of(np.exp(found.x))


def rival_priors(sample: Sample, prior: Prior, lattice: Lattice, most: int) -> tuple[Prior, ...]:
    """Six priors one standard deviation off the likeliest, along independent directions of its logarithms.

    The curvature of the likelihood of about `most` of the displacements tells how sure the prior is.
    """
    few, typical = sample.thinned(most), np.log(typical_prior(lattice).numbers)
    at = np.log(prior.numbers)
    steps = at + SLOPE_STEP * np.eye(len(at))
    here = _unlikely(few, at, typical)[1]
    curvature = np.array([_unlikely(few, logs, typical)[1] - here for logs in steps]) / SLOPE_STEP
    certainty, directions = np.linalg.eigh(0.5 * (curvature + curvature.T))
    sizes = 1.0 / np.sqrt(np.maximum(certainty, LOOSEST**-2))
    return tuple(Prior.of(np.exp(at + size * along)) for size, along in zip(sizes, directions.T, strict=True))


def _unlikely(sample: Sample, logs: Floats, typical: Floats) -> tuple[float, Floats]:
    """Negative log probability of the displacements and of a prior's logarithms (6,), with slopes (6,)."""
    value, slopes = _misfit(sample, np.exp(logs))
    off = (logs - typical) / VAGUE
    return value + 0.5 * float(off @ off), slopes + off / VAGUE


def _bounds(lattice: Lattice, typical: Floats) -> list[tuple[float, float]]:
    shortest = np.log(SHORTEST_CELLS * lattice.cell_mm)
    across_mm, span_mm = _extents_mm(lattice)
    free = [(low - 7.0, low + 5.0) for low in typical]
    free[2] = (shortest, float(np.log(LONGEST_EXTENTS * span_mm)))
    free[3] = (shortest, float(np.log(LONGEST_EXTENTS * across_mm)))
    free[5] = (typical[5] - 1.0, typical[5] + 0.7)
    return free


def _misfit(sample: Sample, numbers: Floats) -> tuple[float, Floats]:
    """Negative log likelihood of the displacements, and its derivatives (6,) by the prior's logarithms."""
    factor = _factor(sample, numbers)
    sources = cho_solve((factor, True), sample.value_mm, check_finite=False)
    inverse, _ = dpotri(factor, lower=1)
    open_ = inverse.T - np.outer(sources, sources)
    slopes = covariance_slopes(sample.places_mm, sample.normals, sample.swell, numbers, open_)
    return float(0.5 * sample.value_mm @ sources + np.log(np.diag(factor)).sum()), 0.5 * slopes


def _factor(sample: Sample, numbers: Floats) -> Floats:
    """The lower Cholesky factor (n, n) of the covariance of the displacements."""
    total = joint_covariance(
        sample.places_mm, sample.normals, sample.swell, numbers, AFFINE, sample.variance_mm2
    )
    try:
        return np.asarray(cholesky(total.T, lower=True, overwrite_a=True, check_finite=False))
    except LinAlgError as error:
        raise CannotFitTwin(f"the equations of the free form are singular: {error}") from error


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Wear:
    """The most probable wear, and how certain it is."""

    freeform: Freeform
    prior: Prior
    sample: Sample
    factor: Floats  # (n, n) Cholesky factor of the covariance of the sample

    def sigma_mm(self, points_mm: Floats, normals: Floats) -> Floats:
        """Standard uncertainty (n,) of the wear under its prior, without ripple, along the normals of
        surface points."""
        lattice, sample = self.freeform.lattice, self.sample
        asked = (lattice.own(points_mm), lattice.own(normals), swell(normals))
        known = (sample.places_mm, sample.normals, sample.swell)
        common = covariance(*known, *asked, self.prior.numbers, AFFINE)
        told = solve_triangular(self.factor, common, lower=True, overwrite_b=True, check_finite=False)
        aligned = (asked[0] ** 2).sum(axis=1) * (asked[1][:, :2] ** 2).sum(axis=1)
        moved_mm2 = AFFINE[0] ** 2 + AFFINE[1] ** 2 * aligned
        before_mm2 = moved_mm2 + self.prior.shift_mm**2 + (self.prior.swelling_mm * asked[2]) ** 2
        return np.asarray(np.sqrt(np.maximum(before_mm2 - np.einsum("kn,kn->n", told, told), 0.0)))

    def doubt_mm(self, points_mm: Floats, normals: Floats, most: int) -> Floats:
        """How far (n,) the wear along the normals might be off because its prior was read from the sample.

        That is how much rival priors would have it otherwise, as about `most` of the places tell.
        """
        lattice, few = self.freeform.lattice, self.sample.thinned(most)
        asked = (lattice.own(points_mm), lattice.own(normals), swell(normals))
        told_mm = _told(few, self.prior, asked)
        rivals = rival_priors(few, self.prior, lattice, most)
        off_mm = [_told(few, rival, asked) - told_mm for rival in rivals]
        return np.asarray(np.linalg.norm(off_mm, axis=0))


def _told(sample: Sample, prior: Prior, asked: tuple[Floats, Floats, Floats]) -> Floats:
    """The most probable displacement (n,) at places, normals and swell asked for."""
    sources = cho_solve((_factor(sample, prior.numbers), True), sample.value_mm, check_finite=False)
    known = (sample.places_mm, sample.normals, sample.swell)
    return np.asarray(covariance(*asked, *known, prior.numbers, AFFINE) @ sources)


def fit_wear(sample: Sample, prior: Prior, lattice: Lattice) -> Wear:
    """The wear that a sample of displacements shows under a prior."""
    factor = _factor(sample, prior.numbers)
    held = cho_solve((factor, True), sample.value_mm, check_finite=False)[:, None]
    pushes, swells = held * sample.normals, held * sample.swell[:, None]
    moved_mm = AFFINE[0] ** 2 * pushes.sum(axis=0)
    leaning = AFFINE[1] ** 2 * sample.places_mm.T @ (pushes * [1.0, 1.0, 0.0])
    sources = np.hstack([prior.shift_mm**2 * pushes, prior.swelling_mm**2 * swells])

    def field(places_mm: Floats) -> Floats:
        values = carried(places_mm, sample.places_mm, prior.numbers, sources)
        values[:, :3] += moved_mm + places_mm @ leaning
        return np.asarray(values)

    freeform = Freeform(lattice=lattice, coefficients=lattice.interpolate(field))
    return Wear(freeform=freeform, prior=prior, sample=sample, factor=factor)
