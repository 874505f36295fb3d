"""How far the form of the part, which no noise averages away, may have moved its pose."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.spatial import cKDTree

from geometry.fit import every, motions
from geometry.nominal import Closest, Nominal
from geometry.types import Floats, Ints

POINTS = 12_000
PATCHES = 200
TURN_MM = 10.0  # a unit of normal counts as this far where points are gathered: patches keep to one side
CHOICES: dict[str, tuple[float, ...]] = {  # of `Field`, in the order in which they are tried
    "reach_mm": (2.0, 4.0, 8.0, 16.0, 32.0, 64.0),
    "variance": (0.1, 0.3, 0.6, 1.0, 2.0, 4.0, 8.0),
    "bend": (0.05, 0.5, 0.95),
    "stretch": (1.0, 3.0, 10.0),
    "power": (1.0, 2.0),
}
PROOF = 10.0  # what twice the log-likelihood must gain before noise counts as form
SWEEPS = 2
FREE = 1e-9  # eigenvalue a point below which no number would be left


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patches:
    """Kept points gathered into patches of surface, twists scaled to displacements at the gyration radius."""

    places_mm: Floats  # (p, 3)
    normals: Floats  # (p, 3)
    sums: Floats  # (p, 6) of what each twist moves the points of a patch along their normals
    mean_mm: Floats  # (p,) residual
    noise_mm2: Floats  # (p,) variance of that mean from what scatters within the patch
    points: Ints  # (p,)


@dataclass(frozen=True, slots=True, kw_only=True)
class Field:
    """Residuals as a stationary field over the surface."""

    variance: float = 1.0  # in that of the patches' means
    reach_mm: float = 8.0
    bend: float = 0.5  # share that moves both sides one way; the rest moves both outwards
    stretch: float = 1.0  # of the reach along the span
    power: float = 2.0  # of the distance in the exponent: 1 rough, 2 smooth

    def covariance(self, patches: "Patches") -> Floats:
        """(p, p) of the patches' means."""
        places = patches.places_mm * [1.0, 1.0, 1.0 / self.stretch]
        facing = patches.normals @ patches.normals.T
        alike = self.bend * facing + (1.0 - self.bend)
        size = self.variance * float(np.mean(patches.mean_mm**2))
        return np.asarray(size * alike * np.exp(-((_apart(places) / self.reach_mm) ** self.power)))


def form_covariance(nominal: Nominal, moved_mm: Floats, found: Closest) -> Floats:
    """Covariance (6, 6) of the twist about the pivot that the part's form gives to a least-squares pose.

    `moved_mm` (n, 3) are the kept points at that pose, `found` their feet. Residuals of a form are alike
    over some distance, so that a million points tell no more of it than the patches that differ. They are
    taken as a field whose covariance falls as exp(-(d / reach)^power), d counted shorter along the span, a
    share of it shifting both sides one way and the rest swelling them; all parameters come from the
    residuals by restricted maximum likelihood (Patterson and Thompson, 1971), which allows for what the
    pose took out of them. Zero where nothing but noise is left.
    """
    scale = np.concatenate([np.full(3, 1.0 / nominal.gyration_mm), np.ones(3)])
    patches, normal_matrix = _gather(nominal, moved_mm, found, scale)
    inverse = _inverse(normal_matrix, int(patches.points.sum())) * scale[:, None]
    spread = inverse @ patches.sums.T
    return np.asarray(spread @ _likeliest(patches).covariance(patches) @ spread.T)


def _gather(nominal: Nominal, moved_mm: Floats, found: Closest, scale: Floats) -> tuple[Patches, Floats]:
    few = every(len(moved_mm), POINTS)
    place = np.column_stack([found.points_mm, TURN_MM * found.normals])[few]
    nodes = place[every(len(few), PATCHES)]
    _, patch = cKDTree(nodes).query(place)
    points = np.bincount(patch, minlength=len(nodes))
    nodes, patch, points = nodes[points > 0], (np.cumsum(points > 0) - 1)[patch], points[points > 0]
    design = motions(moved_mm[few], found.normals[few], nominal.pivot_mm) * scale
    residual_mm = found.distance_mm[few]
    sums = np.column_stack([np.bincount(patch, design[:, i]) for i in range(6)]).astype(np.float64)
    mean_mm = np.bincount(patch, residual_mm) / points
    scatter_mm2 = np.sum((residual_mm - mean_mm[patch]) ** 2) / max(len(few) - len(points), 1)
    patches = Patches(
        places_mm=nodes[:, :3],
        normals=nodes[:, 3:] / TURN_MM,
        sums=sums,
        mean_mm=mean_mm,
        noise_mm2=scatter_mm2 / points,
        points=points,
    )
    return patches, design.T @ design


def _apart(places: Floats) -> Floats:
    squared = np.sum(places**2, axis=1)
    return np.asarray(np.sqrt(np.maximum(squared[:, None] + squared - 2.0 * places @ places.T, 0.0)))


def _likeliest(patches: Patches) -> Field:
    """The likeliest field of those on the grid, one parameter after the other."""
    best = Field()
    least = _misfit(best, patches)
    for name, values in list(CHOICES.items()) * SWEEPS:
        for value in values:
            field = replace(best, **{name: value})
            misfit = least if field == best else _misfit(field, patches)
            if misfit < least:
                best, least = field, misfit
    none = replace(best, variance=0.0)
    return none if _misfit(none, patches) < least + PROOF else best


def _misfit(field: Field, patches: Patches) -> float:
    """Minus twice the restricted log-likelihood, but for a constant."""
    pattern = patches.sums / patches.points[:, None]
    covariance = field.covariance(patches) + np.diag(patches.noise_mm2 + 1e-18)
    try:
        factor = cho_factor(covariance, lower=True)
        solved = cho_solve(factor, np.column_stack([patches.mean_mm, pattern]))
    except LinAlgError:
        return np.inf
    against_pattern = pattern.T @ solved
    small, ridge = against_pattern[:, 1:], 1e-12 * np.trace(against_pattern[:, 1:]) * np.eye(6)
    told = against_pattern[:, 0]
    explained = told @ np.linalg.solve(small + ridge, told)
    log_determinant = 2.0 * np.log(np.diag(factor[0])).sum() + np.linalg.slogdet(small + ridge)[1]
    return float(log_determinant + patches.mean_mm @ solved[:, 0] - explained)


def _inverse(normal_matrix: Floats, points: int) -> Floats:
    """Its inverse; a direction that is free gets a huge but finite variance."""
    values, vectors = np.linalg.eigh(normal_matrix)
    return np.asarray((vectors / np.maximum(values, FREE * points)) @ vectors.T)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Certainty:
    """How far a pose may be off along six independent motions, the surest first."""

    sigma_mm: Floats  # (6,) of the surface's displacement at its radius of gyration
    twists: Floats  # (6, 6), a column each: what moves the surface by 1 mm that way


def certainty(nominal: Nominal, information: Floats, form: Floats) -> Certainty:
    """What noise and form together leave open of a pose."""
    scale = np.concatenate([np.full(3, 1.0 / nominal.gyration_mm), np.ones(3)])
    noise = _inverse(information * np.outer(scale, scale), 1)
    variance, motion = np.linalg.eigh(noise + form / np.outer(scale, scale))
    return Certainty(sigma_mm=np.sqrt(np.maximum(variance, 0.0)), twists=motion * scale[:, None])
