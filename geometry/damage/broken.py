"""The broken surface of one damage: which scan points lie on it, its local shape, which way it faces."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from geometry.damage.facing import outward_sign
from geometry.damage.local_shape import local_quadrics, pieces, spacings_mm, thinned, turn_over
from geometry.damage.skin import Skin
from geometry.errors import CannotRepair
from geometry.types import Bools, Floats, Ints

NEIGHBOURS = 8  # of a point, which tell how deep the break is there
LIKELY = 0.7  # mean depth of the neighbours, in films, at which a point below the skin lies on the break
CERTAIN = 2.0  # own depth in films that needs no neighbours but two
NEAR_SKIN_MM = 0.5  # farther off, a point that no damage claims is none of the blade's
SMOOTH = 0.97  # cosine between break and skin from which on the one runs out into the other
MIN_PLACES = 3  # of a surface
SUPPORT = 2.5  # skin farther than this many point spacings from every sound point is lost or unseen


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scan:
    """The scan in the nominal frame, split by the damage masks."""

    points_mm: Floats  # (n, 3)
    sigma_mm: Floats  # (n,)
    flagged: Bools  # (n,) in any damage
    twin_sigma_mm: float  # of the twin's skin where sound points support it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rim:
    """Scan points on the sound skin near the break, evened out."""

    points_mm: Floats  # (r, 3) as scanned
    feet_mm: Floats  # (r, 3) on the twin
    normals: Floats  # (r, 3) of the twin there

    def clear_of(self, break_mm: Floats, least_mm: float) -> tuple[Floats, Floats, Floats]:
        """Feet, normals and heights above the twin of the points at least so far from the break."""
        clear = cKDTree(break_mm).query(self.points_mm)[0] >= least_mm
        height_mm = ((self.points_mm - self.feet_mm) * self.normals).sum(axis=1)
        return self.feet_mm[clear], self.normals[clear], height_mm[clear]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BrokenSurface:
    """The oriented broken surface of one damage as local quadrics, and the skin that is gone above it."""

    raw_mm: Floats  # (k, 3) the scan points on it
    sigma_mm: float  # of those points, along the normal
    rim: Rim
    points_mm: Floats  # (n, 3) evened out and denoised
    frames: Floats  # (n, 3, 3) rows: two tangents, outward normal (away from metal)
    bending: Floats  # (n, 3) second derivatives uu, uv, vv
    spacing_mm: Floats  # (n,) of those points
    lost_mm: Floats  # (l, 3) samples of the lost skin
    lost_reach_mm: float  # all lost skin lies within this of a sample
    film_mm: float  # skin within this of the twin counts as sound

    @property
    def area_mm2(self) -> float:
        return float((self.spacing_mm**2).sum())

    @property
    def facing(self) -> Floats:
        """The way out: mean outward normal (3,), as long as the surface is flat (1) or wraps around (0)."""
        weight = self.spacing_mm**2 / self.area_mm2
        return np.asarray((self.frames[:, 2] * weight[:, None]).sum(axis=0))


def find_broken_surface(
    skin: Skin, scan: Scan, flagged: Ints, film_sigmas: float, max_gap_mm: float, min_points: int
) -> BrokenSurface:
    """The broken surface under the points `flagged` as one damage.

    Points on it lie provably below the twin. Raises `CannotRepair` if there are fewer than `min_points`, if
    they lie in fewer than `MIN_PLACES` places, or if inside cannot be told from outside.
    """
    pitch_mm = _spacing(scan.points_mm[flagged])
    near = _points_near(scan, flagged, 3.0 * pitch_mm)
    deep = _deep(skin, scan, near, film_sigmas)
    if deep.sum() < min_points:
        raise CannotRepair(f"{deep.sum()} scan points lie provably below the twin, {min_points} are needed")
    raw_mm, sigma_mm = scan.points_mm[near[deep]], float(np.median(scan.sigma_mm[near[deep]]))
    sound_mm = _sound_points(scan, near[~deep], raw_mm)
    places_mm = thinned(raw_mm, 6.0 * sigma_mm)
    if len(places_mm) < MIN_PLACES:
        raise CannotRepair(f"the {len(raw_mm)} scan points on it crowd in {len(places_mm)} place(s)")
    points_mm, frames, bending = _shape(skin, places_mm, sound_mm, 3.0 * pitch_mm)
    spacing_mm = spacings_mm(points_mm)
    lost_pitch_mm = _lost_pitch(skin, points_mm, spacing_mm)
    support_mm = min(SUPPORT * pitch_mm, 0.5 * max_gap_mm)
    lost_mm, lost_normals = _lost_skin(skin, raw_mm, sound_mm, lost_pitch_mm, support_mm)
    turn_over(frames, bending, outward_sign(points_mm, frames[:, 2], lost_mm, lost_normals) < 0.0)
    return BrokenSurface(
        raw_mm=raw_mm,
        sigma_mm=sigma_mm,
        rim=_rim(skin, raw_mm, sound_mm, 1.5 * max_gap_mm, 6.0 * sigma_mm),
        points_mm=points_mm,
        frames=frames,
        bending=bending,
        spacing_mm=spacing_mm,
        lost_mm=lost_mm,
        lost_reach_mm=1.5 * lost_pitch_mm + pitch_mm,
        film_mm=film_sigmas * float(np.hypot(sigma_mm, scan.twin_sigma_mm)),
    )


def _spacing(points_mm: Floats) -> float:
    if len(points_mm) < 3:
        raise CannotRepair(f"{len(points_mm)} scan points on the damage")
    return float(np.median(spacings_mm(points_mm)))


def _points_near(scan: Scan, flagged: Ints, reach_mm: float) -> Ints:
    """Indices of the flagged points, and of those within reach of one that no damage claims."""
    free = _within(scan.points_mm, scan.points_mm[flagged], reach_mm)
    return np.concatenate([flagged, free[~scan.flagged[free]]])


def _deep(skin: Skin, scan: Scan, near: Ints, film_sigmas: float) -> Bools:
    """Which of the points `near` lie below the twin by more than both uncertainties allow.

    Their neighbours decide: where a break runs out towards the skin, a point's own depth would choose those
    that noise pushed down, and the break would seem deeper and wider than it is. Where it ends steeply the
    neighbours tell nothing, and a point proves itself, though not alone.
    """
    depth_mm = -skin.closest(scan.points_mm[near])[0]
    films = depth_mm / (film_sigmas * np.hypot(scan.sigma_mm[near], scan.twin_sigma_mm))
    _, index = cKDTree(scan.points_mm[near]).query(scan.points_mm[near], min(NEIGHBOURS + 1, len(near)))
    around = np.minimum(films[index[:, 1:]], CERTAIN)
    likely = (around.mean(axis=1) > LIKELY) & (films > 0.0)
    proven = (films > CERTAIN) & ((around > 1.0).sum(axis=1) >= 2)
    return np.asarray(likely | proven)


def _sound_points(scan: Scan, shallow: Ints, raw_mm: Floats) -> Floats:
    """Points of the skin round the damage: no mask flags them, or they prove to lie on the twin."""
    margin_mm = 2.0 + float(np.linalg.norm(np.ptp(raw_mm, axis=0)))
    low, high = raw_mm.min(axis=0) - margin_mm, raw_mm.max(axis=0) + margin_mm
    sound = ~scan.flagged
    sound[shallow] = True
    boxed = ((scan.points_mm >= low) & (scan.points_mm <= high)).all(axis=1)
    return scan.points_mm[sound & boxed]


def _shape(skin: Skin, break_mm: Floats, sound_mm: Floats, reach_mm: float) -> tuple[Floats, Floats, Floats]:
    """The quadrics of the break. Where it runs out smoothly into the skin, sound points help to tell them."""
    alone = local_quadrics(break_mm, break_mm)
    beside_mm = sound_mm[_within(sound_mm, break_mm, reach_mm)]
    if not len(beside_mm):
        return alone
    normals = skin.normals[skin.closest(beside_mm)[2]]
    of_break = alone[1][cKDTree(break_mm).query(beside_mm)[1], 2]
    smooth = np.abs((normals * of_break).sum(axis=1)) > SMOOTH
    if not smooth.any():
        return alone
    return local_quadrics(break_mm, np.concatenate([break_mm, beside_mm[smooth]]))


def _lost_pitch(skin: Skin, points_mm: Floats, spacing_mm: Floats) -> float:
    """How densely to sample the lost skin: finer than the break is wide, and than it lies deep."""
    depth_mm = float(np.median(-skin.closest(points_mm)[0]))
    return float(np.clip(min(np.sqrt((spacing_mm**2).sum()) / 15.0, depth_mm), 0.1, 1.0))


def _lost_skin(
    skin: Skin, raw_mm: Floats, sound_mm: Floats, pitch_mm: float, support_mm: float
) -> tuple[Floats, Floats]:
    """Samples, and their normals, of the twin's skin that is lost, from the break on.

    Lost is what has no sound point near it, or lies nearer to the broken surface.
    """
    margin_mm = 2.0 + float(np.linalg.norm(np.ptp(raw_mm, axis=0)))
    box_mm = raw_mm.min(axis=0) - margin_mm, raw_mm.max(axis=0) + margin_mm
    samples = skin.samples(pitch_mm, *box_mm)
    touch_mm = support_mm + 2.0 * pitch_mm
    points, normals = bare_skin(*samples, raw_mm, sound_mm, support_mm, touch_mm, 2.0 * pitch_mm)
    if not len(points):
        raise CannotRepair("no skin is missing above the broken surface")
    return points, normals


def bare_skin(
    points_mm: Floats,
    normals: Floats,
    from_mm: Floats,
    sound_mm: Floats,
    support_mm: float,
    touch_mm: float,
    link_mm: float,
) -> tuple[Floats, Floats]:
    """Those of the samples (n, 3) of skin that are bare, and their normals, in pieces that come as near as
    `touch_mm` to one of the places `from_mm`.

    Bare is what has no sound point within `support_mm`, or lies nearer to those places.
    """
    to_place_mm = cKDTree(from_mm).query(points_mm, distance_upper_bound=touch_mm)[0]
    bare = np.ones(len(points_mm), bool)
    if len(sound_mm):
        bare = cKDTree(sound_mm).query(points_mm)[0] > np.minimum(to_place_mm, support_mm)
    piece = pieces(points_mm[bare], link_mm)
    kept = np.isin(piece, np.unique(piece[np.isfinite(to_place_mm[bare])]))
    return points_mm[bare][kept], normals[bare][kept]


def _rim(skin: Skin, raw_mm: Floats, sound_mm: Floats, width_mm: float, cell_mm: float) -> Rim:
    """The sound points within `width_mm` of the break."""
    points_mm = sound_mm[_within(sound_mm, raw_mm, width_mm)]
    if len(points_mm):
        points_mm = thinned(points_mm, cell_mm)
    height_mm, feet_mm, face = skin.closest(points_mm)
    near = np.abs(height_mm) <= NEAR_SKIN_MM
    return Rim(points_mm=points_mm[near], feet_mm=feet_mm[near], normals=skin.normals[face[near]])


def _within(points_mm: Floats, others_mm: Floats, reach_mm: float) -> Ints:
    """Indices of the points that have one of the others within reach."""
    low, high = others_mm.min(axis=0) - reach_mm, others_mm.max(axis=0) + reach_mm
    boxed = np.flatnonzero(((points_mm >= low) & (points_mm <= high)).all(axis=1))
    distance_mm, _ = cKDTree(others_mm).query(points_mm[boxed], distance_upper_bound=reach_mm)
    return boxed[np.isfinite(distance_mm)]
