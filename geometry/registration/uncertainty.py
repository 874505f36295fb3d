"""How far a pose may be off, from noise and from form, motion by motion."""

from dataclasses import dataclass

import numpy as np

from geometry.blade.nominal import Nominal
from geometry.registration.fit import unit_motions
from geometry.types import Floats

FREE = 1e-9  # eigenvalue a point below which no number would be left
NO_POINT = 1e-9  # counts for so much, where there is none


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Certainty:
    """How far a pose may be off along six independent motions, the surest first."""

    sigma_mm: Floats  # (6,) of the surface's displacement at its radius of gyration
    twists: Floats  # (6, 6), a column each: what moves the surface by 1 mm that way


def certainty(nominal: Nominal, information: Floats, form: Floats) -> Certainty:
    """What noise and form together leave open of a pose."""
    scale = unit_motions(nominal)
    variance, motion = np.linalg.eigh((free_inverse(information, scale) + form) / np.outer(scale, scale))
    return Certainty(sigma_mm=np.sqrt(np.maximum(variance, 0.0)), twists=motion * scale[:, None])


def free_inverse(information: Floats, scale: Floats) -> Floats:
    """The covariance (6, 6) of an information matrix; a free motion gets a huge but finite variance.

    `scale` (6,): what of each component moves the surface by a millimetre.
    """
    root = root_inverse(information * np.outer(scale, scale), 1) * scale[:, None]
    return np.asarray(root @ root.T)


def root_inverse(normal_matrix: Floats, points: float) -> Floats:
    """The inverse root (6, 6) of a normal matrix of so many points; free motions get a huge, finite one."""
    values, vectors = np.linalg.eigh(normal_matrix)
    return np.asarray((vectors / np.sqrt(np.maximum(values, FREE * max(points, NO_POINT)))) @ vectors.T)
