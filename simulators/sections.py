"""What a planar airfoil section is, by dense sums over its curve: the simulator's own definitions.

A section is a closed curve (m, 2) in mm, counter-clockwise seen from +Z, the first point not repeated.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import ConvexHull, cKDTree
from scipy.spatial.distance import pdist, squareform

from simulators.solids import Floats, loop_area_mm2

TOUCHING_POINTS = 900
CIRCLE_STARTS = 3
FIRST_STEP_MM = 0.02
FINE_MM = 0.02


def centroid_mm(curve_mm: Floats) -> Floats:
    """The centre of area (2,) of the section."""
    shifted = curve_mm - curve_mm[0]
    following = np.roll(shifted, -1, axis=0)
    cross = shifted[:, 0] * following[:, 1] - following[:, 0] * shifted[:, 1]
    centre: Floats = curve_mm[0] + ((shifted + following) * cross[:, None]).sum(axis=0) / (3.0 * cross.sum())
    return centre


def chord_mm(curve_mm: Floats) -> float:
    """The caliper chord: the largest distance between two points of the section."""
    return float(pdist(_hull(curve_mm)).max())


def chord_ends_mm(curve_mm: Floats) -> tuple[Floats, Floats]:
    """The two points between which the caliper chord is measured."""
    hull = _hull(curve_mm)
    i, j = np.unravel_index(int(squareform(pdist(hull)).argmax()), (len(hull), len(hull)))
    return hull[i], hull[j]


def _hull(curve_mm: Floats) -> Floats:
    hull: Floats = curve_mm[ConvexHull(curve_mm).vertices]
    return hull


def max_thickness_mm(curve_mm: Floats) -> float:
    """The diameter of the largest circle inside the section.

    The circle that touches the curve at p with inward normal n and reaches q has the radius
    |q - p|^2 / (2 n.(q - p)); the smallest over q is the inscribed one. The best of these start a
    simplex search on the exact distance to the polygon's sides.
    """
    curve_mm = finely(curve_mm)
    points = resampled(curve_mm, _perimeter_mm(curve_mm) / TOUCHING_POINTS)
    inward = -outward_normals(points)
    radii = _touching_radii(points, inward)
    tree = cKDTree(curve_mm)
    starts = np.argsort(-radii)[: 10 * CIRCLE_STARTS : 10]

    def shortfall(centre: Floats) -> float:
        return float(-distance_to_curve_mm(curve_mm, centre[None], tree)[0])

    return -2.0 * min(_lowest(shortfall, points[k] + radii[k] * inward[k]) for k in starts)


def _perimeter_mm(curve_mm: Floats) -> float:
    return float(np.linalg.norm(np.diff(curve_mm, axis=0, append=curve_mm[:1]), axis=1).sum())


def _lowest(height: Callable[[Floats], float], start: Floats) -> float:
    simplex = start + np.array([[0.0, 0.0], [FIRST_STEP_MM, 0.0], [0.0, FIRST_STEP_MM]])
    options: Any = {"xatol": 1e-6, "fatol": 1e-9, "initial_simplex": simplex}
    return float(minimize(height, start, method="Nelder-Mead", options=options).fun)


def _touching_radii(points: Floats, inward: Floats) -> Floats:
    to = points[None] - points[:, None]
    reach = np.einsum("ijk,ik->ij", to, inward)
    with np.errstate(divide="ignore", invalid="ignore"):
        radii = np.where(reach > 0.0, (to**2).sum(axis=2) / (2.0 * reach), np.inf)
    nearest: Floats = radii.min(axis=1)
    return nearest


def finely(curve_mm: Floats) -> Floats:
    """The same polygon with points along its sides, none farther than `FINE_MM` from the next.

    Slices of meshes have sides so long that the corner next to a point need not belong to its nearest side.
    """
    sides = np.roll(curve_mm, -1, axis=0) - curve_mm
    parts = np.maximum(np.ceil(np.linalg.norm(sides, axis=1) / FINE_MM).astype(np.int64), 1)
    along = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    finer: Floats = (
        np.repeat(curve_mm, parts, axis=0)
        + np.repeat(sides, parts, axis=0) * (along / np.repeat(parts, parts))[:, None]
    )
    return finer


def distance_to_curve_mm(curve_mm: Floats, points_mm: Floats, tree: cKDTree | None = None) -> Floats:
    """The distance (n,) of points (n, 2) to the closed polygon, exact for finely sampled curves."""
    nearest = (tree or cKDTree(curve_mm)).query(points_mm)[1]
    sides = [
        _distance_to_sides(points_mm, curve_mm[nearest], np.roll(curve_mm, -turn, axis=0)[nearest])
        for turn in (1, -1)
    ]
    return np.minimum(*sides)


def _distance_to_sides(points_mm: Floats, a: Floats, b: Floats) -> Floats:
    side = b - a
    length2 = np.maximum((side**2).sum(axis=1), 1e-300)
    weight = np.clip(((points_mm - a) * side).sum(axis=1) / length2, 0.0, 1.0)
    distance: Floats = np.linalg.norm(points_mm - a - weight[:, None] * side, axis=1)
    return distance


def outward_normals(curve_mm: Floats) -> Floats:
    """Unit outward normals (m, 2) at the curve's points, by central differences."""
    tangent = np.roll(curve_mm, -1, axis=0) - np.roll(curve_mm, 1, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    return np.column_stack([tangent[:, 1], -tangent[:, 0]])


def resampled(curve_mm: Floats, pitch_mm: float) -> Floats:
    """The polygon resampled at equal arc steps of about `pitch_mm`."""
    closed = np.vstack([curve_mm, curve_mm[:1]])
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    count = max(16, int(np.ceil(arc[-1] / pitch_mm)))
    at = np.arange(count) * arc[-1] / count
    return np.column_stack([np.interp(at, arc, closed[:, k]) for k in range(2)])


def edge_radius_mm(curve_mm: Floats, end_mm: Floats, reach_mm: float) -> float:
    """The radius of the circle that fits the curve best within `reach_mm` of the edge at `end_mm`."""
    dense = resampled(curve_mm, reach_mm / 100.0) - end_mm
    arc = dense[np.linalg.norm(dense, axis=1) < reach_mm]
    rows = np.column_stack([2.0 * arc, np.ones(len(arc))])
    (x, y, power), *_ = np.linalg.lstsq(rows, (arc**2).sum(axis=1), rcond=None)
    return float(np.sqrt(power + x * x + y * y))


@dataclass(frozen=True, slots=True, kw_only=True)
class SectionSizes:
    """The sizes of one section."""

    chord_mm: float
    max_thickness_mm: float
    le_radius_mm: float
    te_radius_mm: float


def sizes(curve_mm: Floats, le_mm: Floats) -> SectionSizes:
    """The sizes of a section whose leading edge is the end of the chord near `le_mm` (2,).

    The edge radii are fitted over 1.2 % of the chord to each side.
    """
    le, te = sorted(chord_ends_mm(curve_mm), key=lambda end: float(np.linalg.norm(end - le_mm)))
    chord = float(np.linalg.norm(te - le))
    return SectionSizes(
        chord_mm=chord,
        max_thickness_mm=max_thickness_mm(curve_mm),
        le_radius_mm=edge_radius_mm(curve_mm, le, 0.012 * chord),
        te_radius_mm=edge_radius_mm(curve_mm, te, 0.012 * chord),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class SectionTruth:
    """One section of the deformed, undamaged part against the same section of the nominal."""

    z_mm: float
    position_x_mm: float
    position_y_mm: float
    orientation_deg: float
    profile_max_mm: float
    profile_min_mm: float
    actual: SectionSizes
    nominal: SectionSizes

    def deviations(self) -> dict[str, float]:
        """The absolute deviations from the nominal, by the names of the plan's limits."""
        found = {
            "position_mm": float(np.hypot(self.position_x_mm, self.position_y_mm)),
            "orientation_deg": abs(self.orientation_deg),
            "profile_mm": max(abs(self.profile_max_mm), abs(self.profile_min_mm)),
        }
        actual, nominal = asdict(self.actual), asdict(self.nominal)
        return found | {key: abs(actual[key] - nominal[key]) for key in actual}


def compare(
    z_mm: float, nominal_mm: Floats, nominal_sizes: SectionSizes, actual_mm: Floats, le_mm: Floats
) -> SectionTruth:
    """The true measurands of the section `actual_mm` against `nominal_mm`, both (m, 2) in one frame.

    `le_mm` (2,) is a point near the leading edge.
    """
    shift = centroid_mm(actual_mm) - centroid_mm(nominal_mm)
    deviation = signed_distance_mm(nominal_mm, actual_mm)
    return SectionTruth(
        z_mm=z_mm,
        position_x_mm=float(shift[0]),
        position_y_mm=float(shift[1]),
        orientation_deg=orientation_deg(nominal_mm, actual_mm),
        profile_max_mm=float(deviation.max()),
        profile_min_mm=float(deviation.min()),
        actual=sizes(actual_mm, le_mm),
        nominal=nominal_sizes,
    )


def signed_distance_mm(curve_mm: Floats, points_mm: Floats) -> Floats:
    """The distance (n,) of points (n, 2) near a smooth closed curve, positive outside."""
    curve_mm = finely(curve_mm)
    tree = cKDTree(curve_mm)
    nearest = tree.query(points_mm)[1]
    across = ((points_mm - curve_mm[nearest]) * outward_normals(curve_mm)[nearest]).sum(axis=1)
    return np.copysign(distance_to_curve_mm(curve_mm, points_mm, tree), across)


def orientation_deg(nominal_mm: Floats, actual_mm: Floats) -> float:
    """The turn, counter-clockwise, that best takes the nominal to the actual about a shared centroid.

    Least squares of the distance along the nominal's normal over equal arcs (Gauss-Newton).
    """
    reference = nominal_mm - centroid_mm(nominal_mm)
    normals = outward_normals(reference)
    tree = cKDTree(reference)
    actual = resampled(actual_mm - centroid_mm(actual_mm), chord_mm(nominal_mm) / 2000.0)
    turn_rad = 0.0
    for _ in range(20):
        c, s = np.cos(-turn_rad), np.sin(-turn_rad)
        back = actual @ np.array([[c, -s], [s, c]]).T
        nearest = tree.query(back)[1]
        gap = ((back - reference[nearest]) * normals[nearest]).sum(axis=1)
        lever = normals[nearest, 1] * back[:, 0] - normals[nearest, 0] * back[:, 1]
        step = float((gap * lever).sum() / (lever**2).sum())
        turn_rad += step
        if abs(step) < 1e-9:
            break
    return float(np.degrees(turn_rad))


def counter_clockwise(curve_mm: Floats) -> Floats:
    """The curve, reversed where needed so that it runs counter-clockwise."""
    return curve_mm if loop_area_mm2(curve_mm) > 0.0 else np.ascontiguousarray(curve_mm[::-1])
