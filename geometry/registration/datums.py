"""Alignments on named datums: root, six points, sections; and how the airfoil moved in service."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from geometry.blade.nominal import Closest, Nominal
from geometry.errors import BadInput, CannotRegister
from geometry.registration.alignment import Alignment, noise_covariance
from geometry.registration.fit import (
    Fit,
    every,
    felt,
    fit_kept,
    fit_robust,
    information,
    motions,
    tukey,
    unit_motions,
)
from geometry.registration.form_effect import Surface, form_effect
from geometry.registration.loose import loose_motions
from geometry.registration.register import RegisterSettings, mask_damage, neighbours_of
from geometry.robust import TUKEY, robust_sigma
from geometry.scan.neighbourhood import Neighboured, surface_shares
from geometry.threads import one_blas_thread
from geometry.transforms import apply, exp, inverse, log
from geometry.types import Bools, Cloud, Floats, Measurand, Unit

SIX = ("primary 1", "primary 2", "primary 3", "secondary 1", "secondary 2", "tertiary")
_STEPS = 30
_CLOSE_MM = 1e-6  # of the surface, between two steps on six points
_LOCAL_STEPS = 8


@dataclass(frozen=True, slots=True, kw_only=True)
class DatumSettings:
    register: RegisterSettings = field(default_factory=RegisterSettings)
    least_points: int = 150  # of every zone or section, undamaged
    margin_mm: float = 2.0  # around a zone: a first pose may be off by this
    section_half_mm: float = 1.0  # on both sides of a section
    radius_mm: float = 2.0  # of the scan's surface about a datum point
    least_local: int = 12  # scan points there
    damaged_share: float = 0.05  # of them, beyond which the datum point lies on damage
    off_nominal_mm: float = 0.5  # at most, of a datum point
    facing: float = 0.5  # least cosine between the surface's normals and the datum point's
    most_condition: float = 300.0  # of the six equations, turns measured at the radius of gyration

    def __post_init__(self) -> None:
        lengths = (self.margin_mm, self.section_half_mm, self.radius_mm, self.off_nominal_mm)
        if not all(np.isfinite(x) and x > 0.0 for x in lengths):
            raise BadInput(f"datums: {self} has a distance that is none")
        if not (self.least_points >= 20 and self.least_local >= 6 and self.most_condition > 1.0):
            raise BadInput(f"datums: {self} asks for too little")


@one_blas_thread
def register_root(
    cloud: Cloud,
    nominal: Nominal,
    start: Alignment,
    datum_z_mm: tuple[float, float],
    settings: DatumSettings = DatumSettings(),
) -> Alignment:
    """The pose that fits the nominal between two heights, and nothing else of it; damage left out.

    Heights are of the nominal and may reach below the airfoil, into the root. `start`: the scan's pose, as
    `register` finds it. Raises `CannotRegister` where too few sound points lie there.
    """
    return _register_bands(cloud, nominal, start, (datum_z_mm,), settings, "root")


@one_blas_thread
def register_sections(
    cloud: Cloud,
    nominal: Nominal,
    start: Alignment,
    z_mm: Sequence[float],
    settings: DatumSettings = DatumSettings(),
) -> Alignment:
    """The pose that fits the nominal at some sections at once; damage left out.

    Raises `CannotRegister` where a section has too few sound points.
    """
    half = settings.section_half_mm
    return _register_bands(
        cloud, nominal, start, tuple((z - half, z + half) for z in z_mm), settings, "sections"
    )


def _register_bands(
    cloud: Cloud,
    nominal: Nominal,
    start: Alignment,
    bands: Sequence[tuple[float, float]],
    settings: DatumSettings,
    method: str,
) -> Alignment:
    """The pose by robust, then plain least squares on the points whose feet lie in the bands."""
    _check_bands(bands)
    moved_mm = apply(start.T_nominal_scan, cloud.points_mm)
    cloud = _part(cloud, _inside(moved_mm[:, 2], bands, settings.margin_mm), settings.register.fit_points)
    feet_mm = nominal.closest(apply(start.T_nominal_scan, cloud.points_mm)).points_mm
    _check_counts(feet_mm[:, 2], bands, settings)
    chosen = np.flatnonzero(_inside(feet_mm[:, 2], bands, 0.0))
    few_mm = cloud.points_mm[chosen[every(len(chosen), settings.register.robust_points)]]
    robust = fit_robust(few_mm, start.T_nominal_scan, nominal)
    fit = replace(robust, found=nominal.closest(apply(robust.T_nominal_scan, cloud.points_mm)))
    nearest = neighbours_of(cloud, settings.register)  # once: each round's mask goes by them, too
    cloud = Neighboured(points_mm=cloud.points_mm, sigma_mm=cloud.sigma_mm, view=cloud.view, nearest=nearest)
    shares = surface_shares(cloud.points_mm, nearest)
    turns = robust.iterations
    for _ in range(settings.register.rounds):
        here = replace(start, T_nominal_scan=fit.T_nominal_scan)
        sound = ~mask_damage(cloud, here, nominal, settings.register) & felt(nominal, fit.found)
        _check_counts(fit.found.points_mm[sound, 2], bands, settings)
        kept = sound & _inside(fit.found.points_mm[:, 2], bands, 0.0)
        fit = fit_kept(cloud.points_mm, fit, kept * shares, nominal)
        turns += fit.iterations
    inliers = float(kept.sum() / _inside(fit.found.points_mm[:, 2], bands, 0.0).sum())
    fit, whole = replace(fit, iterations=turns), _surface(nominal, bands)
    return _alignment(cloud, nominal, start, fit, kept * shares, whole, inliers, method, settings)


def _surface(nominal: Nominal, bands: Sequence[tuple[float, float]]) -> Surface:
    """What of the nominal a scan may see in the bands."""
    inside = _inside(nominal.shell_mm[:, 2], bands, 0.0)
    return Surface(
        points_mm=nominal.shell_mm[inside],
        normals=nominal.shell_normals[inside],
        shares=np.ones(int(inside.sum())),
    )


def _alignment(
    cloud: Cloud,
    nominal: Nominal,
    start: Alignment,
    fit: Fit,
    shares: Floats,
    whole: Surface,
    inliers: float,
    method: str,
    settings: DatumSettings,
) -> Alignment:
    """The alignment of a fit to points for their shares (n,) of the `whole` zone; whether it is this part at
    all was for `start` to tell."""
    kept = shares > 0.0
    moved_mm, found = apply(fit.T_nominal_scan, cloud.points_mm)[kept], fit.found.of(kept)
    known = information(nominal, moved_mm, found.normals, cloud.sigma_mm[kept], shares[kept])
    effect = form_effect(nominal, moved_mm, found, shares[kept], whole)
    loose = tuple(loose_motions(nominal, known, effect, whole, settings.register.loose_mm))
    return replace(
        start,
        method=method,
        T_nominal_scan=fit.T_nominal_scan,
        pivot_mm=nominal.pivot_mm,
        information=known,
        form_covariance=effect.form,
        unseen_covariance=effect.unseen,
        weak_directions=loose if len(loose) > len(fit.weak) else fit.weak,
        rms_mm=float(np.sqrt(np.mean(found.distance_mm**2))),
        noise_mm=robust_sigma(found.distance_mm),
        inlier_fraction=inliers,
        iterations=fit.iterations,
        converged=fit.converged,
    )


def _check_bands(bands: Sequence[tuple[float, float]]) -> None:
    if not bands or not all(np.isfinite(low) and np.isfinite(high) and low < high for low, high in bands):
        raise BadInput(f"datum heights {list(bands)} mm are no bands")


def _check_counts(z_mm: Floats, bands: Sequence[tuple[float, float]], settings: DatumSettings) -> None:
    """Raise `CannotRegister` for the first band with too few of the points at the heights `z_mm` (n,)."""
    for low, high in bands:
        count = int(np.count_nonzero((z_mm >= low) & (z_mm <= high)))
        if count < settings.least_points:
            raise CannotRegister(f"datum z {low:g} to {high:g} mm: {count} sound scan points lie there")


def _inside(z_mm: Floats, bands: Sequence[tuple[float, float]], margin_mm: float) -> Bools:
    inside = np.zeros(len(z_mm), bool)
    for low, high in bands:
        inside |= (z_mm >= low - margin_mm) & (z_mm <= high + margin_mm)
    return inside


def _part(cloud: Cloud, wanted: Bools, most: int) -> Cloud:
    """At most so many of the wanted points."""
    index = np.flatnonzero(wanted)
    index = index[every(len(index), most)]
    return cloud.of(index)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Standing:
    """How the scan's surface stands off the nominal at the six datum points."""

    off_mm: Floats  # (6,) along the nominal normals, positive outside
    sigma_mm: Floats  # (6,)
    residual_mm: Floats  # of the points about the local surfaces, all together


@one_blas_thread
def register_six_point(
    cloud: Cloud,
    nominal: Nominal,
    start: Alignment,
    points_mm: Floats,
    settings: DatumSettings = DatumSettings(),
) -> Alignment:
    """The pose in which the scan's surface passes through six points of the nominal: 3-2-1.

    `points_mm` (6, 3), nominal frame: three on the primary datum, two on the secondary, one on the tertiary.
    Each stands for its foot on the nominal and the normal there, along which alone the scan must coincide.
    Raises `CannotRegister`, with the name of the point, where it lies off the nominal, on damage or without
    scan points; and where the six together leave a motion all but free.
    """
    if np.shape(points_mm) != (6, 3) or not np.isfinite(points_mm).all():
        raise BadInput(f"six-point alignment: {np.shape(points_mm)} is not (6, 3) finite coordinates")
    feet = nominal.closest(np.ascontiguousarray(points_mm, dtype=np.float64))
    _check_each(np.abs(feet.distance_mm) > settings.off_nominal_mm, "lies off the nominal")
    scale = unit_motions(nominal)
    design = motions(feet.points_mm, feet.normals, nominal.pivot_mm) * scale
    condition = float(np.linalg.cond(design))
    if not condition <= settings.most_condition:
        raise CannotRegister(
            f"six-point alignment: the points leave a motion free (condition {condition:.3g})"
        )
    damaged = mask_damage(cloud, start, nominal, settings.register)
    tree = cKDTree(cloud.points_mm)
    T, taken, size_mm = start.T_nominal_scan, 0, np.inf
    while taken < _STEPS and not size_mm < _CLOSE_MM:
        standing = _stand(cloud, tree, damaged, feet, T, nominal, settings)
        step = -np.linalg.solve(design, standing.off_mm)
        T = exp(step * scale, nominal.pivot_mm) @ T
        taken, size_mm = taken + 1, float(np.linalg.norm(step))
    standing = _stand(cloud, tree, damaged, feet, T, nominal, settings)
    rows = design / scale / standing.sigma_mm[:, None]
    return replace(
        start,
        method="six_point",
        T_nominal_scan=T,
        pivot_mm=nominal.pivot_mm,
        information=rows.T @ rows,
        form_covariance=np.zeros((6, 6)),
        unseen_covariance=np.zeros((6, 6)),
        weak_directions=(),
        rms_mm=float(np.sqrt(np.mean(standing.residual_mm**2))),
        noise_mm=robust_sigma(standing.residual_mm),
        inlier_fraction=1.0,
        iterations=taken,
        converged=size_mm < _CLOSE_MM,
    )


def _check_each(bad: Bools, why: str) -> None:
    """Raise `CannotRegister` with the name of the first bad datum point."""
    for name in np.array(SIX)[bad]:
        raise CannotRegister(f"datum point {name} {why}")


def _stand(
    cloud: Cloud,
    tree: cKDTree,
    damaged: Bools,
    feet: Closest,
    T_nominal_scan: Floats,
    nominal: Nominal,
    settings: DatumSettings,
) -> _Standing:
    """The standing of the scan at a pose."""
    at_mm = apply(inverse(T_nominal_scan), feet.points_mm)
    near = [np.array(found, np.int64) for found in tree.query_ball_point(at_mm, settings.radius_mm)]
    locals_ = []
    for name, index, foot_mm, normal in zip(SIX, near, feet.points_mm, feet.normals, strict=True):
        moved_mm = apply(T_nominal_scan, cloud.points_mm[index])
        found = nominal.closest(moved_mm) if len(index) else feet
        facing = found.normals @ normal >= settings.facing if len(index) else np.zeros(0, bool)
        if np.count_nonzero(facing) < settings.least_local:
            raise CannotRegister(f"datum point {name} has {np.count_nonzero(facing)} scan points")
        if not damaged[index[facing]].mean() <= settings.damaged_share:
            raise CannotRegister(f"datum point {name} lies on damage")
        sigma_mm = cloud.sigma_mm[index[facing]]
        locals_.append(_local(found.of(facing), foot_mm, sigma_mm))
    return _Standing(
        off_mm=np.array([one[0] for one in locals_]),
        sigma_mm=np.array([one[1] for one in locals_]),
        residual_mm=np.concatenate([one[2] for one in locals_]),
    )


def _local(found: Closest, foot_mm: Floats, sigma_mm: Floats) -> tuple[float, float, Floats]:
    """Where the scan's surface is at a datum point, along the normal: value, sigma and the points' residuals.

    The surface is the nominal's own, lifted and tilted: a robust plane through the points' distances.
    """
    away_mm = found.points_mm - foot_mm
    _, _, axes = np.linalg.svd(away_mm - away_mm.mean(axis=0), full_matrices=False)
    design = np.column_stack([np.ones(len(away_mm)), away_mm @ axes[:2].T])
    weights = sigma_mm**-2.0
    keep = weights
    for _ in range(_LOCAL_STEPS):
        plane = np.linalg.solve(design.T @ (design * keep[:, None]), design.T @ (keep * found.distance_mm))
        residual_mm = found.distance_mm - design @ plane
        keep = weights * tukey(residual_mm, np.ones(len(design), bool), TUKEY)
    covariance = np.linalg.inv(design.T @ (design * keep[:, None]))
    return float(plane[0]), float(np.sqrt(covariance[0, 0])), residual_mm


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceMotion:
    """How the airfoil stands against its root, as service left it: a rigid motion of the nominal airfoil.

    `bend_x_deg` and `bend_y_deg` turn about the X and Y axes of the nominal, `twist_deg` about Z, all
    counter-clockwise; `tip_*_mm` is where the middle of the tip went.
    """

    bend_x_deg: Measurand
    bend_y_deg: Measurand
    twist_deg: Measurand
    tip_x_mm: Measurand
    tip_y_mm: Measurand
    tip_z_mm: Measurand


def service_motion(root: Alignment, airfoil: Alignment, nominal: Nominal) -> ServiceMotion:
    """The motion from the nominal airfoil to the measured one, once the root is where the nominal has it.

    Sigmas take the two poses for independent, which errs on the safe side where they share points.
    """
    moved = root.T_nominal_scan @ inverse(airfoil.T_nominal_scan)
    twist = log(moved, nominal.pivot_mm)
    covariance = sum(noise_covariance(each) + each.form_covariance for each in (root, airfoil))
    turns = np.rad2deg(np.sqrt(np.diag(covariance)[:3]))
    tip_mm = 0.5 * (nominal.le_line_mm[-1] + nominal.te_line_mm[-1])
    shift_mm = apply(moved, tip_mm[None])[0] - tip_mm
    arm = tip_mm - nominal.pivot_mm
    grown = np.hstack([-np.cross(arm, np.eye(3)).T, np.eye(3)])
    shifts = np.sqrt(np.diag(grown @ covariance @ grown.T))
    return ServiceMotion(
        **_measurands(("bend_x_deg", "bend_y_deg", "twist_deg"), np.rad2deg(twist[:3]), turns, "deg"),
        **_measurands(("tip_x_mm", "tip_y_mm", "tip_z_mm"), shift_mm, shifts, "mm"),
    )


def _measurands(names: Sequence[str], values: Floats, sigmas: Floats, unit: Unit) -> dict[str, Measurand]:
    return {
        name: Measurand(name=name, value=float(value), sigma=float(sigma), unit=unit)
        for name, value, sigma in zip(names, values, sigmas, strict=True)
    }
