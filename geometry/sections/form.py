"""How far a profile is off its nominal: extremes, the share out of tolerance, waviness.

Deviations (m,) are signed distances at the nodes, positive outside; `share_mm` (m,) is the arc that each
node stands for.
"""

from dataclasses import dataclass

import numpy as np

from geometry.sections.curve import Estimate
from geometry.types import Bools, Floats, Ints

SIDES = ("le", "ss", "te", "ps")  # as `NominalSection.side` numbers them: edges, suction, pressure side
SURE = 5.0  # standard errors of what noise cannot explain
FARTHER = 2.0  # sigmas by which a node that is not the farthest may yet be
PROFILE_EXTREMES = ("profile_max_mm", "profile_min_mm", "profile_form_max_mm", "profile_form_min_mm")


def extremes(deviation_mm: Floats, seen: Bools, side: Ints) -> dict[str, Estimate]:
    """Largest and smallest signed distance to the nominal over the seen nodes: of all, and of each side."""
    found = {}
    for name, part in _parts(seen, side):
        found[f"{name}profile_max_mm"] = _at(deviation_mm, highest(deviation_mm, part))
        found[f"{name}profile_min_mm"] = _at(deviation_mm, highest(-deviation_mm, part))
    return found


def extreme_sigmas(deviation_mm: Floats, seen: Bools, side: Ints, sigma_mm: Floats) -> dict[str, float]:
    """The sigmas of these `extremes`, of nodes that are each known to `sigma_mm` (m,)."""
    found = {}
    for name, part in _parts(seen, side):
        found[f"{name}profile_max_mm"] = highest_sigma(deviation_mm, part, sigma_mm)
        found[f"{name}profile_min_mm"] = highest_sigma(-deviation_mm, part, sigma_mm)
    return found


def _parts(seen: Bools, side: Ints) -> list[tuple[str, Bools]]:
    """The seen nodes, of all and of each side, by what the names of their extremes begin with."""
    sides = [(f"{name}_", seen & (side == index)) for index, name in enumerate(SIDES)]
    return [(name, part) for name, part in [("", seen), *sides] if part.any()]


def highest(deviation_mm: Floats, part: Bools) -> int:
    """The node of a part with the largest deviation."""
    return int(np.argmax(np.where(part, deviation_mm, -np.inf)))


def highest_sigma(deviation_mm: Floats, part: Bools, sigma_mm: Floats) -> float:
    """Sigma of the largest deviation over a part, of nodes that are each known to `sigma_mm` (m,).

    In truth another node may lie farthest than that of the largest measured, which is known better, or is
    where a turn of the pose moves nothing. Half of how much farther the extreme were, lay every node out by
    two of its sigmas.
    """
    farther = np.max((deviation_mm + FARTHER * sigma_mm)[part]) - np.max(deviation_mm[part])
    return float(farther / FARTHER)


def with_pose(sigma_mm: Floats, growth: Floats, twist: Floats) -> Floats:
    """Sigmas (m,) of nodes that are each known to `sigma_mm` on a part whose pose has the covariance `twist`
    (6, 6), by which they grow as `growth` (m, 6)."""
    both: Floats = np.sqrt(sigma_mm**2 + ((growth @ twist) * growth).sum(axis=1))
    return both


def _at(deviation_mm: Floats, node: int) -> Estimate:
    gradient = np.zeros(len(deviation_mm))
    gradient[node] = 1.0
    return Estimate(value=float(deviation_mm[node]), gradient=gradient)


def flattened_mm(
    deviation_mm: Floats, node: int, left_over_mm: Floats, sigma_mm: Floats, elsewhere: Bools
) -> float:
    """What smoothing may have taken off an extreme of the profile, as its largest deviation, at `node`.

    There it is what the points next to the node leave over (m,) beyond their noise `sigma_mm` (m,);
    `elsewhere` (m,) what noise cannot explain and would be a farther extreme.
    """
    here = float(np.sqrt(max(left_over_mm[node] ** 2 - sigma_mm[node] ** 2, 0.0)))
    sure = elsewhere & (np.abs(left_over_mm) > SURE * sigma_mm)
    there = np.where(sure, deviation_mm + left_over_mm, -np.inf).max()
    return max(here, float(there - deviation_mm[node]))


def share_beyond(deviation_mm: Floats, share_mm: Floats, tolerance_mm: Floats | float) -> float:
    """The fraction of the arc whose |deviation| is more than the tolerance."""
    return float(share_mm[np.abs(deviation_mm) > tolerance_mm].sum() / share_mm.sum())


def share_beyond_sigma(
    deviation_mm: Floats, sigma_mm: Floats, share_mm: Floats, tolerance_mm: float
) -> float:
    """Sigma of `share_beyond`: half the way from where every node is a sigma better to a sigma worse.

    So much at most, for it takes the errors of all nodes for one: a bound, no Gaussian's sigma, about one
    and a half times what a fraction between 0 and 1 scatters by.
    """
    better = share_beyond(deviation_mm, share_mm, tolerance_mm + sigma_mm)
    worse = share_beyond(deviation_mm, share_mm, np.maximum(tolerance_mm - sigma_mm, 0.0))
    return 0.5 * (worse - better)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WaveBand:
    """The harmonics (2 k, m) of a closed arc whose wavelengths lie in a band, orthonormal over the arc."""

    harmonics: Floats
    share_mm: Floats

    def waves(self, deviation_mm: Floats) -> Floats:
        """The waviness (m,): what the deviation has in the band."""
        waves: Floats = (self.harmonics @ (self.share_mm * deviation_mm)) @ self.harmonics
        return waves

    def rms(self, deviation_mm: Floats) -> Estimate:
        """Root mean square of the waviness over the arc."""
        waves = self.waves(deviation_mm)
        total = float(self.share_mm.sum())
        value = float(np.sqrt((self.share_mm @ waves**2) / total))
        gradient = self.share_mm * waves / (total * value) if value > 0.0 else np.zeros(len(waves))
        return Estimate(value=value, gradient=gradient)

    def height(self, deviation_mm: Floats) -> Estimate:
        """Height of the waviness from its lowest to its highest place."""
        waves = self.waves(deviation_mm)
        top, foot = int(np.argmax(waves)), int(np.argmin(waves))
        lift = (self.harmonics[:, top] - self.harmonics[:, foot]) @ self.harmonics
        return Estimate(value=float(waves[top] - waves[foot]), gradient=lift * self.share_mm)

    def rms_sigma(self, rms_mm: float, along: float, covariance: Floats) -> float:
        """Sigma of the RMS: `along` that of its gradient, with what the noise adds to it.

        `covariance` (2 k, 2 k) of the amplitudes: noise makes waves of its own, and a square does not
        average out.
        """
        noise = float(np.trace(covariance)) / float(self.share_mm.sum())
        added = rms_mm - float(np.sqrt(max(rms_mm**2 - noise, 0.0)))
        return float(np.hypot(along, added))


def wave_band(arc_mm: Floats, share_mm: Floats, wave_mm: tuple[float, float]) -> WaveBand:
    """The harmonics with wavelengths `wave_mm` (shortest, longest) of nodes at `arc_mm` (m,).

    An ideal band pass over the closed arc: no run-in, no run-out. Each is made orthogonal to all longer
    ones, which sums over uneven nodes are only nearly.
    """
    perimeter = float(share_mm.sum())
    first, last = int(np.ceil(perimeter / wave_mm[1])), int(perimeter / wave_mm[0])
    phase = 2.0 * np.pi * np.outer(np.arange(1, last + 1), arc_mm) / perimeter
    pairs = np.stack([np.cos(phase), np.sin(phase)], axis=1).reshape(-1, len(arc_mm))
    root = np.sqrt(share_mm)
    orthonormal = np.linalg.qr((root * np.vstack([np.ones(len(arc_mm)), pairs])).T)[0].T / root
    return WaveBand(harmonics=orthonormal[2 * first - 1 :], share_mm=share_mm)
