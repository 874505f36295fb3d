"""Motions along which a pose is all but free: how far it may be off is more than a verdict can bear."""

import numpy as np

from geometry.blade.nominal import Nominal
from geometry.registration.fit import motions, unit_motions, unit_twist
from geometry.registration.form_effect import FormEffect, Surface
from geometry.registration.uncertainty import NO_POINT, certainty
from geometry.types import Floats

HELD = 0.003  # mean square of a surface's displacement along its normal, for one of a millimetre in all


def loose_motions(
    nominal: Nominal, information: Floats, effect: FormEffect, whole: Surface, loose_mm: float
) -> list[tuple[float, ...]]:
    """Unit twists along which the pose may be off its best fit by more than `loose_mm`, one sigma.

    The best fit is that of the `whole` surface: noise, and the form of what was not seen, take a pose off
    it. Along a motion that even the whole surface hardly feels, a screw's, there is no such fit but what the
    form makes of it: there all of the form's share counts.
    """
    own = left_to_form(nominal, whole)
    off = certainty(nominal, information, effect.unseen + own @ effect.form @ own.T)
    return [unit_twist(twist) for twist in off.twists.T[off.sigma_mm > loose_mm]]


def left_to_form(nominal: Nominal, whole: Surface) -> Floats:
    """The part (6, 6) of a twist that the surface hardly feels."""
    scale = unit_motions(nominal)
    design = motions(whole.points_mm, whole.normals, nominal.pivot_mm) * scale
    share = max(float(whole.shares.sum()), NO_POINT)
    felt, motion = np.linalg.eigh((design.T * whole.shares) @ design / share)
    free = motion[:, felt < HELD]
    return np.asarray(scale[:, None] * (free @ free.T) / scale)
