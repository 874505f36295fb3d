"""What the mean camber line tells: how much it bends, and where the section is thickest."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from geometry.kernels.airfoil import inscribed_circles
from geometry.robust import TUKEY, biweight, spread
from geometry.sections.chart import outward_normals
from geometry.sections.chords import Line
from geometry.sections.curve import CamberLine, Estimate, Pair
from geometry.types import Floats

_SPANS = 6  # of the smooth camber line
_OFF = 2e-4  # of the chord: nearer to the smooth line than this every circle counts in full


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Circles:
    """Inscribed circles seen from a line: their centres' places along and across it, with their growth."""

    along_mm: Floats  # (k,)
    across_mm: Floats  # (k,)
    across: Floats  # (2,) unit vector
    swing: Floats  # (k,): growth of `across_mm` with the first contact's displacement, minus the other's


def _seen(curve_mm: Floats, camber: CamberLine, line: Line) -> _Circles:
    across = np.array([-line.along[1], line.along[0]])
    normals = outward_normals(curve_mm)
    apart = normals[camber.node] - normals[camber.contact]
    away = camber.centre_mm - line.nose_mm
    return _Circles(
        along_mm=away @ line.along,
        across_mm=away @ across,
        across=across,
        swing=(apart @ across) / (apart * apart).sum(axis=1),
    )


def max_camber(curve_mm: Floats, camber: CamberLine, line: Line) -> Estimate:
    """The largest distance of the mean camber line from the chord nose to tail, at most its own length.

    The line is a cubic spline of six spans through the centres of the inscribed circles, each mm of chord
    weighing the same; circles that a nick shrinks or a burr pushes aside are told by their distance from
    it (Tukey's biweight) and do not count.
    """
    seen = _seen(curve_mm, camber, line)
    order = np.argsort(seen.along_mm)
    place, height = seen.along_mm[order], seen.across_mm[order]
    low, high = float(place[0]), float(place[-1])
    knots = np.concatenate([[low] * 3, np.linspace(low, high, _SPANS + 1), [high] * 3])
    basis = BSpline.design_matrix(np.clip(place, low, high), knots, 3).toarray()
    share = np.gradient(place)
    weight = np.ones(len(place))
    for _ in range(8):
        weighted = basis.T * (share * weight)
        off = height - basis @ np.linalg.solve(weighted @ basis, weighted @ height)
        scale = spread(off) + _OFF * (high - low)
        weight = biweight(off, TUKEY * scale)
    pull = np.linalg.solve(weighted @ basis, weighted)
    fine = np.linspace(low, high, 2001)
    heights = BSpline(knots, pull @ height, 3)(fine)
    top = int(np.argmax(np.abs(heights)))
    row = BSpline.design_matrix(fine[top : top + 1], knots, 3).toarray()[0] @ pull
    sign = float(np.sign(heights[top]))
    gradient = np.zeros(len(curve_mm))
    felt = sign * row * seen.swing[order]
    np.add.at(gradient, camber.node[order], felt)
    np.add.at(gradient, camber.contact[order], -felt)
    up = float(fine[top]) / line.length.value
    gradient -= sign * seen.across @ ((1.0 - up) * line.nose_growth + up * line.tail_growth)
    return Estimate(value=float(abs(heights[top])), gradient=gradient)


def thickest_at(curve_mm: Floats, pair: Pair, line: Line) -> Estimate:
    """Where along the chord, from the nose, the section is thickest.

    The vertex of the parabola through the radii of the inscribed circles in the nodes of the pair: a
    section is nearly as thick some way before and behind, so that the one largest circle wanders.
    """
    normals = outward_normals(curve_mm)
    radius, contact = inscribed_circles(curve_mm, normals, pair.node, pair.across)
    centre = curve_mm[pair.node] - radius[:, None] * normals[pair.node]
    place = (centre - line.nose_mm) @ line.along
    middle, reach = float(place.mean()), float(np.ptp(place)) / 2.0
    t = (place - middle) / reach
    share = np.abs(np.gradient(place))
    basis = np.vander(t, 3, increasing=True)
    weighted = basis.T * share
    pull = np.linalg.solve(weighted @ basis, weighted)
    _, linear, square = pull @ radius
    vertex = -0.5 * linear / square
    felt = reach * (-0.5 * pull[1] / square + 0.5 * linear * pull[2] / square**2)
    gradient = np.zeros(len(curve_mm))
    np.add.at(gradient, pair.node, 0.5 * felt)
    np.add.at(gradient, contact, 0.5 * felt)
    return Estimate(value=middle + reach * float(vertex), gradient=gradient)


def thickness_at(
    curve_mm: Floats, pair: Pair, end: tuple[Floats, Floats], inward: Floats, distance_mm: float
) -> Estimate:
    """Diameter of the inscribed circle whose centre is `distance_mm` inward of an end of the caliper chord.

    From the circles in the nodes of the pair, by a straight line through their radii: where the section
    tapers, an edge that moves takes the place along. `end`: its place (2,) and growth (2, m).
    """
    normals = outward_normals(curve_mm)
    radius, contact = inscribed_circles(curve_mm, normals, pair.node, pair.across)
    place = (curve_mm[pair.node] - radius[:, None] * normals[pair.node] - end[0]) @ inward
    off = place - place.mean()
    slope = float(off @ radius) / float(off @ off)
    value = 2.0 * (float(radius.mean()) + slope * (distance_mm - float(place.mean())))
    wedge = -(normals[pair.node] * normals[contact]).sum(axis=1)  # 1 where the two sides are parallel
    share = 2.0 / (len(radius) * (1.0 + wedge))
    gradient = 2.0 * slope * (inward @ end[1])
    np.add.at(gradient, pair.node, share * wedge)
    np.add.at(gradient, contact, share)
    return Estimate(value=value, gradient=gradient)
