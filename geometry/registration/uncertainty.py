"""How far the form of the part, which no noise averages away, may have moved its pose."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from geometry.blade.nominal import UP, Closest, Nominal
from geometry.blade.span import on_line_mm
from geometry.registration.fit import every, motions, unit_motions
from geometry.types import Bools, Floats

POINTS = 12_000
WAVES = 28  # half waves along the chord and along the span, at most
POINTS_A_WAVE = 8  # at least so many points a pattern
SPREAD = 1.0  # half waves over which the power of patterns is taken for alike
BANDS = (1.5, 3.5, 7.0)  # half waves: long ones, and those half as long
STEEP = (0.5, 4.0)  # least and most fall of power with frequency beyond what is seen, as an exponent
FINE = 0.6  # of the highest frequency, beyond which form is all but noise
PROOF = 1.25  # of the noise, below which power is none of the form: a dozen squares scatter by as much
MEDIAN = 0.455  # of chi-squared with one degree of freedom
FEW = 1.25  # what a variance from a dozen squares is short of, so that errors stay within its sigmas
FREE = 1e-9  # eigenvalue a point below which no number would be left


def form_covariance(nominal: Nominal, moved_mm: Floats, found: Closest) -> Floats:
    """Covariance (6, 6) of the twist about the pivot that the part's form gives to a least-squares pose.

    `moved_mm` (n, 3) are the kept points at that pose, `found` their feet. Residuals of a form are alike
    over some distance, so that a million points tell no more of it than the patterns that differ: cosines
    along chord and span, alike and opposite on the two sides, and those of the end faces. What a pattern of
    unit size does to the pose is plain; how large it is, is read off the residuals. Of patterns that the
    pose took out of them the size is that of their neighbours in frequency, rising towards long waves as
    the rest does. The bulge of the true surface over the nominal's flat facets joins as one more pattern.
    """
    few = every(len(moved_mm), POINTS)
    feet_mm, normals = found.points_mm[few], found.normals[few]
    scale = unit_motions(nominal)
    design = motions(moved_mm[few], normals, nominal.pivot_mm) * scale
    whiten = _root_inverse(design.T @ design, len(few))
    pose = design @ whiten
    left_mm = found.distance_mm[few] - pose @ (pose.T @ found.distance_mm[few])
    spread = np.zeros((6, 6))
    for shape, chordwise, spanwise in _patterns(nominal, feet_mm, normals):
        spread += _leaked(left_mm, pose, shape[:, None] * chordwise, spanwise)
    bulge = pose.T @ nominal.bulge_mm[found.face[few]]
    spread += np.outer(bulge, bulge)
    back = whiten * scale[:, None]
    return np.asarray(back @ spread @ back.T)


def _root_inverse(normal_matrix: Floats, points: int) -> Floats:
    values, vectors = np.linalg.eigh(normal_matrix)
    return np.asarray((vectors / np.sqrt(np.maximum(values, FREE * points))) @ vectors.T)


def _patterns(nominal: Nominal, feet_mm: Floats, normals: Floats) -> list[tuple[Floats, Floats, Floats]]:
    """Families of patterns: a factor (n,) and cosines (n, i) along the chord and (n, j) along the span."""
    z_mm = feet_mm[:, 2]
    le_mm, te_mm = (on_line_mm(line, z_mm) for line in (nominal.le_line_mm, nominal.te_line_mm))
    chord = te_mm - le_mm
    along = np.sum((feet_mm[:, :2] - le_mm) * chord, axis=1) / np.sum(chord**2, axis=1)
    up = (z_mm - z_mm.min()) / max(float(np.ptp(z_mm)), 1e-9)
    side = np.where(chord[:, 0] * normals[:, 1] > chord[:, 1] * normals[:, 0], 1.0, -1.0)
    lid: Bools = np.abs(normals[:, 2]) > UP
    chordwise, spanwise = (_cosines(place, len(feet_mm)) for place in (along, up))
    wall = (~lid).astype(np.float64)
    families = [(wall, chordwise, spanwise), (wall * side, chordwise, spanwise)]
    if lid.any():
        families.append((lid.astype(np.float64), chordwise, spanwise[:, :1]))
    return families


def _cosines(place: Floats, points: int) -> Floats:
    """Half waves (n, w) over places between 0 and 1."""
    waves = min(WAVES, max(2, int(np.sqrt(points / POINTS_A_WAVE))))
    return np.cos(np.pi * np.outer(np.clip(place, 0.0, 1.0), np.arange(waves)))


def _leaked(left_mm: Floats, pose: Floats, chordwise: Floats, spanwise: Floats) -> Floats:
    """Covariance (6, 6) that one family of patterns gives to the pose, in the motions (n, 6) of unit size."""
    size = np.sqrt(np.maximum((chordwise**2).T @ spanwise**2, 1e-12))
    power = (((chordwise * left_mm[:, None]).T @ spanwise) / size) ** 2
    leaks = np.stack([((chordwise * motion[:, None]).T @ spanwise) / size for motion in pose.T])
    seen = np.clip(1.0 - np.sum(leaks**2, axis=0), 0.0, 1.0)
    return np.asarray(np.einsum("ij,kij,lij->kl", _form_power(power, seen), leaks, leaks))


def _form_power(power: Floats, seen: Floats) -> Floats:
    """Variance (i, j) of each pattern of the form, from the power seen and the share of it that was."""
    frequency = np.hypot(*np.indices(power.shape))
    fine = frequency >= FINE * frequency.max()
    noise = float(np.median(power[fine] / np.maximum(seen[fine], 0.1))) / MEDIAN
    weight = np.maximum(gaussian_filter(seen, SPREAD), 1e-3)
    form = np.maximum(gaussian_filter(power, SPREAD) / weight - PROOF * noise, 0.0)
    reached = np.exp(gaussian_filter(seen * np.log1p(frequency), SPREAD) / weight)
    return FEW * form * np.maximum(reached / (1.0 + frequency), 1.0) ** _fall(power, seen, frequency, noise)


def _fall(power: Floats, seen: Floats, frequency: Floats, noise: float) -> float:
    """How steeply power falls with frequency among the long waves, as an exponent."""
    low, middle, high = BANDS
    long_, short = (frequency >= low) & (frequency < middle), (frequency >= middle) & (frequency < high)
    sizes = [power[band].sum() / max(float(seen[band].sum()), 1e-3) - noise for band in (long_, short)]
    ratio = max(sizes[0], 0.05 * noise) / max(sizes[1], 0.05 * noise, 1e-18)
    return float(np.clip(np.log(max(ratio, 1e-9)) / np.log(middle / low), *STEEP))


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
    root = _root_inverse(information * np.outer(scale, scale), 1) * scale[:, None]
    return np.asarray(root @ root.T)
