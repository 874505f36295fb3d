"""Where else along a motion that the surface hardly feels its ends would fit: a tip face, a platform."""

import numpy as np

from geometry.blade.nominal import Nominal
from geometry.registration.fit import every, felt
from geometry.transforms import apply, exp
from geometry.types import Floats

POINTS = 1500
LEAST = 5  # points on an end that make it one
FARTHEST_MM = 4.0
APART_MM = 0.5
MOST = 3
HELD = 0.8  # share of the explained points that a move must leave so


def slides_mm(
    explained_mm: Floats,
    unexplained_mm: Floats,
    twist: Floats,
    reach_mm: float,
    near_mm: float,
    nominal: Nominal,
) -> Floats:
    """How far to move along `twist` that unexplained points come to lie on the nominal: at most three
    moves, the one that explains most first.

    Points (n, 3) are in the nominal frame; `twist` moves the surface by 1 mm, and no farther than
    `reach_mm` is tried. Explained is what lies within `near_mm`, and should mostly remain so.
    """
    rest_mm, held_mm = (mm[every(len(mm), POINTS)] for mm in (unexplained_mm, explained_mm))
    if len(rest_mm) < LEAST:
        return np.zeros(0)
    steps = int(np.ceil(min(reach_mm, FARTHEST_MM) / near_mm))
    moves_mm = np.arange(-steps, steps + 1).astype(np.float64) * near_mm
    counts = np.array([_explained(rest_mm, move * twist, near_mm, nominal) for move in moves_mm])
    chosen = [move for move in moves_mm[_peaks(moves_mm, counts)] if abs(move) > 0.5 * near_mm]
    enough = HELD * _explained(held_mm, np.zeros(6), near_mm, nominal)
    return np.array([m for m in chosen if _explained(held_mm, m * twist, near_mm, nominal) >= enough])


def _explained(points_mm: Floats, twist: Floats, near_mm: float, nominal: Nominal) -> int:
    found = nominal.closest(apply(exp(twist, nominal.pivot_mm), points_mm))
    return int(np.sum((np.abs(found.distance_mm) <= near_mm) & felt(nominal, found)))


def _peaks(moves_mm: Floats, counts: Floats) -> list[int]:
    """The moves that explain most, the nearer of equals first, none close to a better one."""
    peaks: list[int] = []
    for i in np.lexsort([np.abs(moves_mm), -counts]):
        if counts[i] >= LEAST and all(abs(moves_mm[i] - moves_mm[j]) > APART_MM for j in peaks):
            peaks.append(int(i))
    return peaks[:MOST]
