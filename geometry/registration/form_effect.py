"""What the form of the part, which no noise averages away, gives to its pose."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from geometry.blade.nominal import Closest, Nominal, of_end_faces
from geometry.blade.span import on_line_mm
from geometry.registration.fit import every, motions, unit_motions
from geometry.registration.uncertainty import root_inverse
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Surface:
    """Points (n, 3) of the nominal surface with unit normals (n, 3), each for its share (n,) of a fit."""

    points_mm: Floats
    normals: Floats
    shares: Floats

    def of(self, few: "Few") -> "Surface":
        """Those of the points that are chosen, each for those it stands for."""
        return Surface(
            points_mm=self.points_mm[few.chosen],
            normals=self.normals[few.chosen],
            shares=self.shares[few.chosen] * few.stand_for,
        )


def required(nominal: Nominal) -> Surface:
    """All of the nominal's surface that a scan should see."""
    samples = nominal.samples
    return Surface(points_mm=samples.points_mm, normals=samples.normals, shares=samples.area_mm2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FormEffect:
    """Covariances (6, 6) of the twist about the pivot that the form of a part gives to its pose."""

    form: Floats  # against the pose of a part without form
    unseen: Floats  # against the pose of its whole surface: nothing where all of it was seen


def form_effect(
    nominal: Nominal, moved_mm: Floats, found: Closest, shares: Floats, whole: Surface
) -> FormEffect:
    """What the part's form gives to a least-squares pose, and what of it the `whole` surface would not.

    `moved_mm` (n, 3) are the kept points at that pose, `found` their feet, each for its share (n,).
    Residuals of a form are alike over some distance, so that a million points tell no more of it than the
    patterns that differ: cosines along chord and span, alike and opposite on the two sides, and those of the
    end faces. What a pattern of unit size does to the pose is plain; how large it is, is read off the
    residuals. Of patterns that the pose took out of them the size is that of their neighbours in frequency,
    rising towards long waves as the rest does. The bulge of the true surface over the nominal's flat facets
    joins as one more pattern.
    """
    few, whole = _few_of(found.normals), whole.of(_few_of(whole.normals))
    seen = Surface(points_mm=found.points_mm, normals=found.normals, shares=shares).of(few)
    design, whiten = _fit_of(nominal, moved_mm[few.chosen], seen)
    pose, root = design @ whiten, np.sqrt(seen.shares)
    off_mm = root * found.distance_mm[few.chosen]
    left_mm = off_mm - pose @ (pose.T @ off_mm)
    waves = _waves_of(seen)
    pairs = zip(_patterns(nominal, seen, waves), _patterns(nominal, whole, waves), strict=True)
    of_whole = _pose_of(nominal, whole) @ np.linalg.inv(whiten)
    families = [_family(left_mm, pose, here, of_whole, everywhere) for here, everywhere in pairs]
    noise_mm2 = _noise_mm2(families)
    form, unseen = np.sum([family.leaked(noise_mm2) for family in families], axis=0)
    bulge = pose.T @ (root * nominal.bulge_mm[found.face[few.chosen]])
    back = whiten * unit_motions(nominal)[:, None]
    return FormEffect(
        form=np.asarray(back @ (form + np.outer(bulge, bulge)) @ back.T),
        unseen=np.asarray(back @ unseen @ back.T),
    )


def _fit_of(nominal: Nominal, points_mm: Floats, surface: Surface) -> tuple[Floats, Floats]:
    """Weighted unit motions (n, 6) of points over a surface, and the inverse root (6, 6) of their squares."""
    rows = motions(points_mm, surface.normals, nominal.pivot_mm) * unit_motions(nominal)
    design = rows * np.sqrt(surface.shares)[:, None]
    return design, root_inverse(design.T @ design, float(surface.shares.sum()))


def _pose_of(nominal: Nominal, surface: Surface) -> Floats:
    """What each point (n, 6) of a surface would give to its own least-squares pose, in unit motions."""
    design, root = _fit_of(nominal, surface.points_mm, surface)
    return np.asarray(design @ root @ root)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Few:
    """Indices (k,) of points, apart on walls and on end faces, and how many each stands for."""

    chosen: Ints
    stand_for: Floats


def _few_of(normals: Floats) -> Few:
    lid = of_end_faces(normals)
    walls, ends = np.flatnonzero(~lid), np.flatnonzero(lid)
    of_walls, of_ends = walls[every(len(walls), POINTS)], ends[every(len(ends), ON_ENDS)]
    each = [len(walls) / max(len(of_walls), 1), len(ends) / max(len(of_ends), 1)]
    return Few(
        chosen=np.concatenate([of_walls, of_ends]), stand_for=np.repeat(each, [len(of_walls), len(of_ends)])
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Waves:
    """How many half waves the points of a scan tell apart, and the heights that those along the span fit."""

    low_mm: float
    height_mm: float
    on_walls: int
    on_ends: int  # 0: no end face was seen


def _waves_of(seen: Surface) -> Waves:
    z_mm, ends = seen.points_mm[:, 2], int(of_end_faces(seen.normals).sum())
    return Waves(
        low_mm=float(z_mm.min()),
        height_mm=max(float(np.ptp(z_mm)), 1e-9),
        on_walls=_told_apart(int(np.sqrt(len(z_mm) // POINTS_A_WAVE))),
        on_ends=_told_apart(ends // POINTS_A_WAVE) if ends else 0,
    )


def _told_apart(waves: int) -> int:
    return min(WAVES, max(2, waves))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Patterns:
    """A family of patterns on points: a factor (n,) and cosines (n, i) along the chord, (n, j) the span."""

    factor: Floats
    chordwise: Floats
    spanwise: Floats

    def along(self, values: Floats) -> Floats:
        """The sum (i, j) of values (n,) times each pattern."""
        return np.asarray((self.chordwise * (self.factor * values)[:, None]).T @ self.spanwise)

    def sizes(self) -> Floats:
        squares = ((self.factor[:, None] * self.chordwise) ** 2).T @ self.spanwise**2
        return np.asarray(np.sqrt(np.maximum(squares, 1e-12)))


def _patterns(nominal: Nominal, surface: Surface, waves: Waves) -> list[Patterns]:
    """Families on the points of a surface, each weighted by the root of its share."""
    z_mm, root = surface.points_mm[:, 2], np.sqrt(surface.shares)
    le_mm, te_mm = (on_line_mm(line, z_mm) for line in (nominal.le_line_mm, nominal.te_line_mm))
    chord = te_mm - le_mm
    along = np.sum((surface.points_mm[:, :2] - le_mm) * chord, axis=1) / np.sum(chord**2, axis=1)
    along, up = np.clip(along, 0.0, 1.0), (z_mm - waves.low_mm) / waves.height_mm
    side = np.where(chord[:, 0] * surface.normals[:, 1] > chord[:, 1] * surface.normals[:, 0], root, -root)
    lid = of_end_faces(surface.normals)
    chordwise, spanwise = (_cosines(place, waves.on_walls) for place in (along, up))
    families = [
        Patterns(factor=np.where(lid, 0.0, factor), chordwise=chordwise, spanwise=spanwise)
        for factor in (root, side)
    ]
    if waves.on_ends:
        across = _cosines(along, waves.on_ends)
        families.append(Patterns(factor=np.where(lid, root, 0.0), chordwise=across, spanwise=spanwise[:, :1]))
    return families


def _cosines(place: Floats, waves: int) -> Floats:
    """Half waves (n, w) over places between 0 and 1; beyond, they go on."""
    return np.cos(np.pi * np.outer(place, np.arange(waves)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Family:
    """Patterns (i, j): the power found of each, the share that the pose left, what a unit of it moves."""

    power: Floats
    seen: Floats
    leaks: Floats  # (6, i, j)
    unseen: Floats  # (6, i, j): more than it would move, were the whole surface seen
    stands_for: float  # by how much the power of noise exceeds that of the noise of one point

    @property
    def frequency(self) -> Floats:
        return np.asarray(np.hypot(*np.indices(self.power.shape)))

    def leaked(self, noise_mm2: float) -> Floats:
        """Covariances (2, 6, 6) that the form gives to the pose, and unseen, in unit motions."""
        form = _form_power(self, noise_mm2 * self.stands_for)
        both = np.stack([self.leaks, self.unseen])
        return np.asarray(np.einsum("ij,pkij,plij->pkl", form, both, both))


def _family(left_mm: Floats, pose: Floats, here: Patterns, of_whole: Floats, everywhere: Patterns) -> Family:
    sizes = here.sizes()
    leaks = np.stack([here.along(motion) / sizes for motion in pose.T])
    would_be = np.stack([everywhere.along(motion) / sizes for motion in of_whole.T])
    shares = here.factor**2
    return Family(
        power=(here.along(left_mm) / sizes) ** 2,
        seen=np.clip(1.0 - np.sum(leaks**2, axis=0), 0.0, 1.0),
        leaks=leaks,
        unseen=leaks - would_be,
        stands_for=float(np.sum(shares**2)) / max(float(np.sum(shares)), 1e-12),
    )


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
