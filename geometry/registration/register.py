"""Cloud onto nominal: coarse, robust, then plain least squares on what is not damaged."""

from dataclasses import dataclass, field, replace

import numpy as np

from geometry.blade.nominal import Closest, Nominal
from geometry.errors import BadInput, CannotRegister
from geometry.registration.alignment import Alignment
from geometry.registration.coarse import Coarse, CoarseSettings, find_pose
from geometry.registration.ends import on_rim, without_strays
from geometry.registration.fit import Fit, every, felt, fit_kept, fit_robust, unit_twist
from geometry.registration.form_effect import required
from geometry.registration.loose import loose_motions
from geometry.registration.mask import MaskSettings, damaged, form_of, ringed
from geometry.registration.settled import Settled, held_by_ends
from geometry.registration.size import check_size
from geometry.registration.slide import LEAST, slides_mm
from geometry.robust import robust_sigma
from geometry.scan.neighbourhood import nearest_of, surface_shares
from geometry.threads import one_blas_thread
from geometry.transforms import apply, exp
from geometry.types import Bools, Cloud, Floats, Ints


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisterSettings:
    coarse: CoarseSettings = field(default_factory=CoarseSettings)
    mask: MaskSettings = field(default_factory=MaskSettings)
    least_points: int = 200
    robust_points: int = 8000  # of the cloud, for the robust fit
    fit_points: int = 250_000  # of the cloud, for mask and least squares: 0.0005 mm of noise at most
    rounds: int = 2  # of mask and least squares
    explained_mm: float = 0.3
    loose_mm: float = 0.3  # off the best fit along a motion, one sigma, that makes it a free one
    slide_mm: float = 0.05  # off a part without form, beyond which other places along that motion are tried

    def __post_init__(self) -> None:
        if not (self.least_points >= 50 and self.robust_points >= 500 and self.rounds >= 1):
            raise BadInput(f"register: {self} asks for too few points or rounds")
        if not min(self.explained_mm, self.loose_mm, self.slide_mm) > 0.0:
            raise BadInput(f"register: {self} has a distance that is none")


@one_blas_thread
def register(cloud: Cloud, nominal: Nominal, settings: RegisterSettings = RegisterSettings()) -> Alignment:
    """The pose of the scan on the nominal.

    Coarse by principal axes and many starts, then point-to-plane with Tukey's weights on the exact mesh,
    then rounds of damage mask and plain least squares on the rest. Neither step moves along a direction that
    the surface does not feel (a constant section with linear twist is a screw). Where noise and form leave
    one open, other places along it are tried for the ends that they would explain; what stays open is
    reported. Raises `CannotRegister` for a cloud too small, in another unit or without shape.
    """
    if len(cloud) < settings.least_points:
        raise CannotRegister(f"{len(cloud)} scan points are fewer than {settings.least_points}")
    coarse = find_pose(cloud.points_mm, nominal, settings.coarse)
    check_size(cloud.points_mm, nominal)
    cloud = _thinned(cloud, settings.fit_points)
    few_mm = cloud.points_mm[every(len(cloud), settings.robust_points)]
    robust = fit_robust(few_mm, coarse.T_nominal_scan, nominal)
    neighbours = neighbours_of(cloud, settings)
    shares = surface_shares(cloud.points_mm, neighbours)
    settled = _settled(cloud, robust, neighbours, shares, nominal, settings)
    places = [settled, *_elsewhere(cloud, settled, neighbours, shares, nominal, settings)]
    return _alignment(cloud, nominal, places, coarse, robust.iterations, settings)


def neighbours_of(cloud: Cloud, settings: RegisterSettings) -> Ints:
    """The neighbours (n, k) of each point that mask and shares go by, the point itself first; -1 none."""
    return nearest_of(cloud, min(settings.mask.neighbours + 1, len(cloud)))


def _thinned(cloud: Cloud, most: int) -> Cloud:
    if len(cloud) <= most:
        return cloud
    kept = every(len(cloud), most)
    return cloud.of(kept)


def _settled(
    cloud: Cloud,
    start: Fit,
    neighbours: Ints,
    shares: Floats,
    nominal: Nominal,
    settings: RegisterSettings,
) -> Settled:
    """Rounds of mask and least squares on the whole cloud.

    The fit rests on the ring round damage, too: each sound point left out lets form into the pose. It is
    one to the surface, however densely each part of it was seen.
    """
    found, turns = nominal.closest(apply(start.T_nominal_scan, cloud.points_mm)), 0
    fit = replace(start, found=found)
    for _ in range(settings.rounds):
        moved_mm = apply(fit.T_nominal_scan, cloud.points_mm)
        judged = _past_rims_none(moved_mm, fit.found, nominal, settings.explained_mm)
        damage = _damage_of(cloud, judged, neighbours, settings.mask)
        sound, clear = ~damage, ~ringed(damage, neighbours, settings.mask)
        held = int((sound & felt(nominal, fit.found)).sum())
        if held < settings.least_points:
            raise CannotRegister(f"{held} scan points lie on the nominal")
        resting = without_strays(sound, clear, fit.found, nominal)
        fit = fit_kept(cloud.points_mm, fit, resting * shares, nominal)
        turns += fit.iterations
    resting = without_strays(sound, clear, fit.found, nominal)
    return held_by_ends(cloud, replace(fit, iterations=turns), sound, resting * shares, nominal)


def _past_rims_none(moved_mm: Floats, found: Closest, nominal: Nominal, aside_mm: float) -> Closest:
    """The same feet, those on a rim without a distance unless their points (n, 3) lie further aside.

    A scan may slide past its end and is no damage; a fixture beside that end is none of the blade's.
    """
    near = np.linalg.norm((moved_mm - found.points_mm)[:, :2], axis=1) <= aside_mm
    past = near & on_rim(nominal, found.points_mm)
    return replace(found, distance_mm=np.where(past, 0.0, found.distance_mm))


def _elsewhere(
    cloud: Cloud,
    settled: Settled,
    neighbours: Ints,
    shares: Floats,
    nominal: Nominal,
    settings: RegisterSettings,
) -> list[Settled]:
    """Other poses along the least certain motion that explain more of the scan and are surer of it."""
    sigma_mm, twist = float(settled.certainty.sigma_mm[-1]), settled.certainty.twists[:, -1]
    if sigma_mm <= settings.slide_mm:
        return []
    T, found = settled.fit.T_nominal_scan, settled.fit.found
    near_mm = max(4.0 * robust_sigma(found.distance_mm[settled.kept]), 0.05)
    moved_mm = apply(T, cloud.points_mm)
    off = (np.abs(found.distance_mm) > near_mm) & ~settled.kept
    places = []
    for move_mm in slides_mm(moved_mm[settled.kept], moved_mm[off], twist, 4.0 * sigma_mm, near_mm, nominal):
        moved = replace(settled.fit, T_nominal_scan=exp(move_mm * twist, nominal.pivot_mm) @ T)
        place = _settled(cloud, moved, neighbours, shares, nominal, settings)
        surer = place.certainty.sigma_mm[-1] < 0.5 * sigma_mm
        if surer and place.kept.sum() >= settled.kept.sum() + LEAST:
            places.append(place)
    return sorted(places, key=lambda place: -int(place.kept.sum()))


def _damage_of(cloud: Cloud, found: Closest, neighbours: Ints, settings: MaskSettings) -> Bools:
    floor_mm = float(np.median(cloud.sigma_mm)) / np.sqrt(neighbours.shape[1])
    form_mm = form_of(found.points_mm, found.normals, found.distance_mm, settings)
    return damaged(found.distance_mm - form_mm, neighbours, floor_mm, settings)


def _alignment(
    cloud: Cloud,
    nominal: Nominal,
    places: list[Settled],
    coarse: Coarse,
    iterations: int,
    settings: RegisterSettings,
) -> Alignment:
    settled = places[min(1, len(places) - 1)]
    fit, kept = settled.fit, settled.kept
    moved_mm = apply(fit.T_nominal_scan, cloud.points_mm)
    residual_mm = fit.found.distance_mm[kept]
    on_part = moved_mm[:, 2] >= nominal.z_min_mm
    explained = np.abs(fit.found.distance_mm[on_part]) <= settings.explained_mm
    return Alignment(
        method="airfoil",
        T_nominal_scan=fit.T_nominal_scan,
        pivot_mm=nominal.pivot_mm,
        information=settled.information,
        form_covariance=settled.effect.form,
        unseen_covariance=settled.effect.unseen,
        weak_directions=_weak(nominal, places, settings),
        rms_mm=float(np.sqrt(np.mean(residual_mm**2))),
        noise_mm=robust_sigma(residual_mm),
        inlier_fraction=float(kept.mean()),
        explained_fraction=float(explained.mean()) if len(explained) else 0.0,
        runner_up_ratio=coarse.runner_up_ratio,
        iterations=iterations + fit.iterations,
        converged=fit.converged,
    )


def _weak(
    nominal: Nominal, places: list[Settled], settings: RegisterSettings
) -> tuple[tuple[float, ...], ...]:
    """Unit twists that the chosen place leaves open, or that two places contest."""
    chosen = places[min(1, len(places) - 1)]
    open_ = loose_motions(nominal, chosen.information, chosen.effect, required(nominal), settings.loose_mm)
    if len(places) > 2 and not _won(places):
        open_ = open_ or [unit_twist(places[0].certainty.twists[:, -1])]
    return tuple(open_) if len(open_) > len(chosen.fit.weak) else chosen.fit.weak


def _won(places: list[Settled]) -> bool:
    """Whether the best other place explains twice as many more points as the next that is another one."""
    first, best, *rest = places
    gain = int(best.kept.sum() - first.kept.sum())
    rivals = [r for r in rest if not np.allclose(r.fit.T_nominal_scan, best.fit.T_nominal_scan, atol=0.05)]
    return all(gain >= 2 * int(r.kept.sum() - first.kept.sum()) for r in rivals)


@one_blas_thread
def mask_damage(
    cloud: Cloud,
    alignment: Alignment,
    nominal: Nominal,
    settings: RegisterSettings = RegisterSettings(),
) -> Bools:
    """The points (n,) of an aligned cloud that lie on damage, with the points next to it."""
    found = nominal.closest(apply(alignment.T_nominal_scan, cloud.points_mm))
    neighbours = neighbours_of(cloud, settings)
    return ringed(_damage_of(cloud, found, neighbours, settings.mask), neighbours, settings.mask)
