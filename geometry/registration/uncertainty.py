"""How far the form of the part, which no noise averages away, may have moved its pose."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from geometry.blade.nominal import Closest, Nominal, of_end_faces
from geometry.blade.span import on_line_mm
from geometry.registration.fit import every, motions, unit_motions
from geometry.types import Floats, Ints

POINTS = 12_000  # of the walls
ON_ENDS = 3_000  # of end faces beside them: of the few that these have, a part would tell noise for form
WAVES = 28  # half waves along the chord and along the span, at most
POINTS_A_WAVE = 8  # at least so many points a pattern
SPREAD = 1.0  # half waves over which the power of patterns is taken for alike
BANDS = (1.5, 3.5, 7.0)  # half waves: long ones, and those half as long
STEEP = (0.5, 4.0)  # least and most fall of power with frequency beyond what is seen, as an exponent
FINE = 0.6  # of the highest frequency, beyond which form is all but noise
SQUARES = 2.0 * np.sqrt(np.pi) * SPREAD  # patterns along chord or span that `SPREAD` makes a mean of
PROOF = 1.0  # of the scatter of a mean of squares of noise: what is no further beyond noise is no form
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
    few, root = _sampled(found.normals)
    feet_mm, normals = found.points_mm[few], found.normals[few]
    scale = unit_motions(nominal)
    design = root[:, None] * motions(moved_mm[few], normals, nominal.pivot_mm) * scale
    whiten = _root_inverse(design.T @ design, len(moved_mm))
    pose = design @ whiten
    off_mm = root * found.distance_mm[few]
    left_mm = off_mm - pose @ (pose.T @ off_mm)
    families = [
        _family(left_mm, pose, root * shape, chordwise, spanwise)
        for shape, chordwise, spanwise in _patterns(nominal, feet_mm, normals)
    ]
    noise_mm2 = _noise_mm2(families)
    spread = np.sum([family.leaked(noise_mm2) for family in families], axis=0)
    bulge = pose.T @ (root * nominal.bulge_mm[found.face[few]])
    spread += np.outer(bulge, bulge)
    back = whiten * scale[:, None]
    return np.asarray(back @ spread @ back.T)


def _sampled(normals: Floats) -> tuple[Ints, Floats]:
    """Indices (k,) of points, apart on walls and on end faces, and the root of how many each stands for."""
    lid = of_end_faces(normals)
    walls, ends = np.flatnonzero(~lid), np.flatnonzero(lid)
    of_walls, of_ends = walls[every(len(walls), POINTS)], ends[every(len(ends), ON_ENDS)]
    stands_for = np.repeat(
        [len(walls) / max(len(of_walls), 1), len(ends) / max(len(of_ends), 1)], [len(of_walls), len(of_ends)]
    )
    return np.concatenate([of_walls, of_ends]), np.sqrt(stands_for)


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
    lid = of_end_faces(normals)
    patterns = len(feet_mm) // POINTS_A_WAVE
    chordwise, spanwise = (_cosines(place, int(np.sqrt(patterns))) for place in (along, up))
    wall = (~lid).astype(np.float64)
    families = [(wall, chordwise, spanwise), (wall * side, chordwise, spanwise)]
    if lid.any():
        across = _cosines(along, int(lid.sum()) // POINTS_A_WAVE)
        families.append((lid.astype(np.float64), across, spanwise[:, :1]))
    return families


def _cosines(place: Floats, waves: int) -> Floats:
    """Half waves (n, w) over places between 0 and 1."""
    return np.cos(np.pi * np.outer(np.clip(place, 0.0, 1.0), np.arange(min(WAVES, max(2, waves)))))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Family:
    """Patterns (i, j): the power found of each, the share that the pose left, what a unit of it moves."""

    power: Floats
    seen: Floats
    leaks: Floats  # (6, i, j)
    stands_for: float  # points that each of its points stands for, by which the power of noise grows

    @property
    def frequency(self) -> Floats:
        return np.asarray(np.hypot(*np.indices(self.power.shape)))

    def leaked(self, noise_mm2: float) -> Floats:
        """Covariance (6, 6) that the form gives to the pose, in the motions of unit size."""
        form = _form_power(self, noise_mm2 * self.stands_for)
        return np.asarray(np.einsum("ij,kij,lij->kl", form, self.leaks, self.leaks))


def _family(left_mm: Floats, pose: Floats, shape: Floats, chordwise: Floats, spanwise: Floats) -> Family:
    chordwise = shape[:, None] * chordwise
    size = np.sqrt(np.maximum((chordwise**2).T @ spanwise**2, 1e-12))
    power = (((chordwise * left_mm[:, None]).T @ spanwise) / size) ** 2
    leaks = np.stack([((chordwise * motion[:, None]).T @ spanwise) / size for motion in pose.T])
    seen = np.clip(1.0 - np.sum(leaks**2, axis=0), 0.0, 1.0)
    stands_for = max(float(np.sum(shape**2)) / max(int(np.count_nonzero(shape)), 1), 1.0)
    return Family(power=power, seen=seen, leaks=leaks, stands_for=stands_for)


def _noise_mm2(families: list[Family]) -> float:
    """Variance of the noise of a point: the median over the fine patterns of all families."""
    powers = []
    for family in families:
        fine = family.frequency >= FINE * family.frequency.max()
        powers.append(family.power[fine] / np.maximum(family.seen[fine], 0.1) / family.stands_for)
    return float(np.median(np.concatenate(powers))) / MEDIAN


def _form_power(family: Family, noise: float) -> Floats:
    """Variance (i, j) of each pattern of the form, from the power seen and the share of it that was."""
    power, seen, frequency = family.power, family.seen, family.frequency
    weight = np.maximum(gaussian_filter(seen, SPREAD), 1e-3)
    squares = SQUARES ** sum(count > 1 for count in power.shape)
    scatter = np.sqrt(2.0 * gaussian_filter(seen**2, SPREAD / np.sqrt(2.0)) / squares) / weight
    form = np.maximum(gaussian_filter(power, SPREAD) / weight - (1.0 + PROOF * scatter) * noise, 0.0)
    reached = np.exp(gaussian_filter(seen * np.log1p(frequency), SPREAD) / weight)
    return FEW * form * np.maximum(reached / (1.0 + frequency), 1.0) ** _fall(family, noise)


def _fall(family: Family, noise: float) -> float:
    """How steeply power falls with frequency among the long waves, as an exponent."""
    low, middle, high = BANDS
    long_, short = _above_noise(family, noise, low, middle), _above_noise(family, noise, middle, high)
    return float(np.clip(np.log(long_ / short) / np.log(middle / low), *STEEP))


def _above_noise(family: Family, noise: float, of: float, to: float) -> float:
    """Mean power of the form at frequencies from `of` to `to`, at least as much as so few leave unknown."""
    band = (family.frequency >= of) & (family.frequency < to)
    seen = max(float(family.seen[band].sum()), 1e-3)
    unknown = max(np.sqrt(2.0 / seen), 0.05)
    return max(float(family.power[band].sum()) / seen - noise, unknown * noise, 1e-18)


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
