"""A least-squares pose with what it is worth; ends of the scan hold what its surface leaves open."""

from dataclasses import dataclass, replace

import numpy as np

from geometry.blade.nominal import Nominal
from geometry.registration.ends import End, scan_ends
from geometry.registration.fit import Fit, Held, felt, fit_kept, information, motions, unit_motions
from geometry.registration.form_effect import FormEffect, form_effect, required
from geometry.registration.uncertainty import Certainty, certainty, free_inverse
from geometry.transforms import apply, inverse
from geometry.types import Bools, Cloud, Floats

ENDS_MM = 0.01  # standard uncertainty of the surface along a motion beyond which ends of the scan are asked
LOOKS = 4  # at the ends: how far they reach is told best by points evenly around them
CLOSE_MM = 0.03  # that a look at the ends moves them, from where on another would see the same
LEAST_WEIGHT = 1e-3  # of the lighter end beside all points: enough that no step leaves it out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Settled:
    """A least-squares pose, the points it rests on, and how certain it is."""

    fit: Fit
    kept: Bools
    normal_matrix: Floats  # (6, 6) of the kept points, each by its share
    information: Floats
    effect: FormEffect
    certainty: Certainty


def held_by_ends(cloud: Cloud, fit: Fit, sound: Bools, shares: Floats, nominal: Nominal) -> Settled:
    """What a least-squares pose on points with these shares (n,) is worth; where they leave a motion open,
    and the scan, as far as it is sound (n,), stops sharply at both ends of the nominal, the pose that lays
    these ends on it, too.

    An end is told worse the further it is from its place: each pose that ends gave is the next one to look
    from, until one stays. If none does, the fit has not converged.
    """
    settled = _worth(cloud, fit, shares, nominal)
    if not settled.certainty.sigma_mm[-1] > ENDS_MM:
        return settled
    turns = fit.iterations
    for _ in range(LOOKS):
        ends = scan_ends(apply(fit.T_nominal_scan, cloud.points_mm), sound, fit.found, nominal)
        if not ends:
            return settled
        held = _held(ends, fit, settled, nominal)
        fit = fit_kept(cloud.points_mm, fit, shares, nominal, held, steps=30)
        turns += fit.iterations
        moved_mm = held.rows(fit.T_nominal_scan, nominal.pivot_mm).off_mm - [end.off_mm for end in ends]
        stays = bool(np.abs(moved_mm).max() < CLOSE_MM)
        if stays:
            break
    fit = replace(fit, iterations=turns, converged=fit.converged and stays)
    return _with_ends(settled, fit, held, ends, nominal)


def _worth(cloud: Cloud, fit: Fit, shares: Floats, nominal: Nominal) -> Settled:
    kept = (shares > 0.0) & felt(nominal, fit.found)
    share = shares[kept]
    moved_mm, found = apply(fit.T_nominal_scan, cloud.points_mm)[kept], fit.found.of(kept)
    known = information(nominal, moved_mm, found.normals, cloud.sigma_mm[kept], share)
    effect = form_effect(nominal, moved_mm, found, share, required(nominal))
    design = motions(moved_mm, found.normals, nominal.pivot_mm)
    return Settled(
        fit=fit,
        kept=kept,
        normal_matrix=(design.T * share) @ design,
        information=known,
        effect=effect,
        certainty=certainty(nominal, known, effect.form),
    )


def _held(ends: tuple[End, ...], fit: Fit, settled: Settled, nominal: Nominal) -> Held:
    """The ends seen at `fit`, weighted as points are, by the variance that these show along the open motion;
    where that is next to nothing, both as much more as the lighter needs to count."""
    open_ = settled.certainty.twists[:, -1]
    a_point_mm2 = float(settled.certainty.sigma_mm[-1] ** 2 * (open_ @ settled.normal_matrix @ open_))
    weights = a_point_mm2 / np.array([end.sigma_mm for end in ends]) ** 2
    least = LEAST_WEIGHT * len(settled.kept)
    back = inverse(fit.T_nominal_scan)
    return Held(
        points_mm=apply(back, np.array([end.point_mm for end in ends])),
        heights_mm=np.array([end.height_mm for end in ends]),
        weights=weights * max(1.0, least / float(weights.min())),
    )


def _with_ends(settled: Settled, fit: Fit, held: Held, ends: tuple[End, ...], nominal: Nominal) -> Settled:
    """The same points with ends beside them: covariances as that weighted least squares passes them on."""
    rows = held.rows(fit.T_nominal_scan, nominal.pivot_mm)
    weighted = rows.design.T * rows.weights
    scale = unit_motions(nominal)
    unit = np.outer(scale, scale)
    both = np.linalg.inv((settled.normal_matrix + weighted @ rows.design) * unit) * unit
    share = both @ settled.normal_matrix
    noise = share @ free_inverse(settled.information, scale) @ share.T
    noise += both @ (weighted * [end.sigma_mm**2 for end in ends]) @ weighted.T @ both
    known = np.linalg.inv(noise / unit) / unit
    effect = FormEffect(
        form=share @ settled.effect.form @ share.T, unseen=share @ settled.effect.unseen @ share.T
    )
    return replace(
        settled,
        fit=fit,
        information=known,
        effect=effect,
        certainty=certainty(nominal, known, effect.form),
    )
