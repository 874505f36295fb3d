"""Cloud onto nominal: coarse, robust, then plain least squares on what is not damaged."""

from dataclasses import dataclass, field

import numpy as np

from geometry.coarse import Coarse, CoarseSettings, find_pose
from geometry.errors import BadInput, CannotRegister
from geometry.fit import Fit, every, felt, fit_kept, fit_robust, information
from geometry.mask import MaskSettings, damaged, form_of, robust_sigma
from geometry.nominal import Closest, Nominal
from geometry.surface import k_nearest
from geometry.transforms import apply
from geometry.types import Bools, Cloud, Floats, Ints


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Alignment:
    """The pose of the scan on the nominal, how it was found and how certain it is.

    A pose error is a twist (rx, ry, rz in rad, tx, ty, tz in mm) that turns about `pivot_mm` and
    then shifts, applied on the nominal side: `exp(twist, pivot_mm) @ T_nominal_scan`.
    `information` (6, 6) is the inverse covariance of that twist from point noise alone.
    """

    method: str
    T_nominal_scan: Floats  # (4, 4)
    pivot_mm: Floats  # (3,), nominal frame
    information: Floats  # (6, 6)
    weak_directions: tuple[tuple[float, ...], ...]  # unit twists the surface leaves free
    rms_mm: float  # of the kept points, along the normal
    noise_mm: float  # robust standard deviation of the kept residuals
    inlier_fraction: float  # kept as undamaged
    explained_fraction: float  # scan points that the nominal explains (within a few tenths of a mm)
    runner_up_ratio: float  # score of the second-best coarse pose over the best; 1 = ambiguous
    iterations: int
    converged: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisterSettings:
    coarse: CoarseSettings = field(default_factory=CoarseSettings)
    mask: MaskSettings = field(default_factory=MaskSettings)
    least_points: int = 200
    robust_points: int = 8000  # of the cloud, for the robust fit
    fit_points: int = 250_000  # of the cloud, for mask and least squares: 0.0005 mm of noise at most
    rounds: int = 2  # of mask and least squares
    explained_mm: float = 0.3

    def __post_init__(self) -> None:
        if not (self.least_points >= 50 and self.robust_points >= 500 and self.rounds >= 1):
            raise BadInput(f"register: {self} asks for too few points or rounds")
        if not self.explained_mm > 0.0:
            raise BadInput(f"register: explained_mm = {self.explained_mm} is not a distance")


def register(cloud: Cloud, nominal: Nominal, settings: RegisterSettings = RegisterSettings()) -> Alignment:
    """The pose of the scan on the nominal.

    Coarse by principal axes and many starts, then point-to-plane with Tukey's weights on the exact mesh,
    then rounds of damage mask and plain least squares on the rest. Neither step moves along a direction that
    the surface does not feel (a constant section with linear twist is a screw); such are reported.
    Raises `CannotRegister` for a cloud too small or without shape.
    """
    if len(cloud) < settings.least_points:
        raise CannotRegister(f"{len(cloud)} scan points are fewer than {settings.least_points}")
    coarse = find_pose(cloud.points_mm, nominal, settings.coarse)
    cloud = _thinned(cloud, settings.fit_points)
    few_mm = cloud.points_mm[every(len(cloud), settings.robust_points)]
    robust = fit_robust(few_mm, coarse.T_nominal_scan, nominal)
    neighbours, _ = k_nearest(cloud.points_mm, min(settings.mask.neighbours + 1, len(cloud)))
    fit, kept, turns = _fit_undamaged(cloud, robust, neighbours, nominal, settings)
    return _alignment(cloud, nominal, fit, kept, coarse, robust.iterations + turns, settings)


def _thinned(cloud: Cloud, most: int) -> Cloud:
    kept = every(len(cloud), most)
    return Cloud(points_mm=cloud.points_mm[kept], sigma_mm=cloud.sigma_mm[kept], view=cloud.view[kept])


def _fit_undamaged(
    cloud: Cloud, start: Fit, neighbours: Ints, nominal: Nominal, settings: RegisterSettings
) -> tuple[Fit, Bools, int]:
    """Rounds of mask and least squares on the whole cloud: the fit, the kept points, the steps taken."""
    found = nominal.closest(apply(start.T_nominal_scan, cloud.points_mm))
    fit = Fit(
        T_nominal_scan=start.T_nominal_scan,
        found=found,
        weak=start.weak,
        iterations=0,
        converged=start.converged,
    )
    turns = 0
    for _ in range(settings.rounds):
        kept = ~_damage_of(cloud, fit.found, neighbours, nominal, settings) & felt(nominal, fit.found)
        if kept.sum() < settings.least_points:
            raise CannotRegister(f"{int(kept.sum())} scan points lie on the nominal")
        fit = fit_kept(cloud.points_mm, fit, kept, nominal)
        turns += fit.iterations
    return fit, kept, turns


def _damage_of(
    cloud: Cloud, found: Closest, neighbours: Ints, nominal: Nominal, settings: RegisterSettings
) -> Bools:
    floor_mm = float(np.median(cloud.sigma_mm)) / np.sqrt(neighbours.shape[1])
    form_mm = form_of(found.points_mm, found.normals, found.distance_mm, settings.mask)
    return damaged(found.distance_mm - form_mm, neighbours, floor_mm, settings.mask)


def _alignment(
    cloud: Cloud,
    nominal: Nominal,
    fit: Fit,
    kept: Bools,
    coarse: Coarse,
    iterations: int,
    settings: RegisterSettings,
) -> Alignment:
    moved_mm = apply(fit.T_nominal_scan, cloud.points_mm)
    residual_mm = fit.found.distance_mm[kept]
    on_part = moved_mm[:, 2] >= nominal.z_min_mm
    explained = np.abs(fit.found.distance_mm[on_part]) <= settings.explained_mm
    return Alignment(
        method="airfoil",
        T_nominal_scan=fit.T_nominal_scan,
        pivot_mm=nominal.pivot_mm,
        information=information(nominal, moved_mm[kept], fit.found.normals[kept], cloud.sigma_mm[kept]),
        weak_directions=fit.weak,
        rms_mm=float(np.sqrt(np.mean(residual_mm**2))),
        noise_mm=robust_sigma(residual_mm),
        inlier_fraction=float(kept.mean()),
        explained_fraction=float(explained.mean()) if len(explained) else 0.0,
        runner_up_ratio=coarse.runner_up_ratio,
        iterations=iterations,
        converged=fit.converged,
    )


def mask_damage(
    cloud: Cloud,
    alignment: Alignment,
    nominal: Nominal,
    settings: RegisterSettings = RegisterSettings(),
) -> Bools:
    """The points (n,) of an aligned cloud that lie on damage, with one ring of neighbours around it."""
    found = nominal.closest(apply(alignment.T_nominal_scan, cloud.points_mm))
    neighbours, _ = k_nearest(cloud.points_mm, min(settings.mask.neighbours + 1, len(cloud)))
    return _damage_of(cloud, found, neighbours, nominal, settings)
