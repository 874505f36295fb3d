"""What is measured on a closed section curve, each definition in one function.

The functions are pure and serve the nominal and the measured section alike. Curves (m, 2) are closed,
counter-clockwise, the first point not repeated. An `Estimate` carries its growth with the displacement
of every node along the outward normal, from which a sigma is propagated.
"""

from dataclasses import dataclass

import numpy as np

from geometry.errors import CannotMeasure
from geometry.kernels.airfoil import area_moments, closed_steps, inscribed_circles
from geometry.kernels.profile import nearest_nodes
from geometry.sections.chart import outward_normal, outward_normals
from geometry.types import Floats, Ints


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate:
    """A value and its growth with each node's displacement along the outward normal, (m,)."""

    value: float
    gradient: Floats


def node_shares(curve_mm: Floats) -> Floats:
    """Arc length that each node of a closed curve stands for, (m,)."""
    after = closed_steps(np.ascontiguousarray(curve_mm))
    shares: Floats = 0.5 * (after + np.concatenate([after[-1:], after[:-1]]))
    return shares


def node_arc(curve_mm: Floats) -> Floats:
    """Arc length (m,) at which each node of a closed curve stands, from node 0."""
    step = np.linalg.norm(np.diff(curve_mm, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(step)])


def area(curve_mm: Floats) -> float:
    """Enclosed area of a counter-clockwise closed polygon, mm2."""
    return float(area_moments(np.ascontiguousarray(curve_mm))[0])


def centroid(curve_mm: Floats) -> Floats:
    """Centroid (2,) of the enclosed area: the stacking point of the section."""
    whole, x, y = area_moments(np.ascontiguousarray(curve_mm))
    return curve_mm[0] + np.array([x, y]) / whole


def centroid_gradient(curve_mm: Floats) -> Floats:
    """(2, m): growth of the centroid with each node's displacement; metal added away from it pulls."""
    arm = (curve_mm - centroid(curve_mm)).T
    return arm * node_shares(curve_mm) / area(curve_mm)


def orientation(curve_mm: Floats, nominal_mm: Floats) -> Estimate:
    """Turn (rad) counter-clockwise that takes the nominal onto the curve, once they share a centroid.

    Best fit: the turn of least squared distance to the nominal, every mm of arc weighing the same. The
    nodes of the two correspond, at least roughly: from there the nearest one is sought.
    Source: thesis 4.4.2, after Khameneifar and Feng (its reference 6).
    """
    normals = outward_normals(nominal_mm)
    home = centroid(nominal_mm)
    weight = node_shares(curve_mm)
    arm = curve_mm - centroid(curve_mm)
    turn = 0.0
    for _ in range(10):
        c, s = np.cos(turn), np.sin(turn)
        back = home + arm @ np.array([[c, -s], [s, c]])
        near = nearest_nodes(back, nominal_mm)
        n = normals[near]
        lever = n[:, 1] * (back[:, 0] - home[0]) - n[:, 0] * (back[:, 1] - home[1])
        distance = ((back - nominal_mm[near]) * n).sum(axis=1)
        step = float((weight * lever) @ distance) / float((weight * lever) @ lever)
        turn += step
        if abs(step) < 1e-9:
            break
    stiffness = float((weight * lever) @ lever)
    pull = (weight * lever) @ n
    return Estimate(value=turn, gradient=(weight * lever - pull @ centroid_gradient(curve_mm)) / stiffness)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Edge:
    """One edge of the nominal section: nodes that belong to its zone and to its rounding."""

    zone: Ints  # contiguous, in order, within 8 % of the perimeter from the edge point
    arc: Ints  # of these, where the normal lies within 60 deg of the edge's own direction
    flank: tuple[int, int]  # on the two sides, 4 % of the perimeter away; their normals give the direction

    def direction(self, curve_mm: Floats) -> Floats:
        """The unit direction (2,) in which the edge of a curve points: halfway between its flanks."""
        one, other = self.flank
        apart = outward_normal(curve_mm, one) - outward_normal(curve_mm, other)
        halfway = np.array([apart[1], -apart[0]]) / np.linalg.norm(apart)
        outward = 2.0 * curve_mm[self.zone[len(self.zone) // 2]] - curve_mm[one] - curve_mm[other]
        return halfway if float(halfway @ outward) > 0.0 else -halfway


def edge(nominal_mm: Floats, tip: int) -> Edge:
    """The edge about node `tip`.

    Its direction halves the angle between the normals of the two sides, 4 % of the perimeter away.
    """
    m = len(nominal_mm)
    share = node_shares(nominal_mm)
    place = np.cumsum(share) - share
    away = (place - place[tip] + 0.5 * share.sum()) % share.sum() - 0.5 * share.sum()
    order = (tip + np.arange(-m // 2, m // 2)) % m
    zone = order[np.abs(away[order]) <= 0.08 * share.sum()]
    normals = outward_normals(nominal_mm)[zone]
    angle = np.unwrap(np.arctan2(normals[:, 1], normals[:, 0]))
    first, *_, last = np.flatnonzero(np.abs(away[zone]) <= 0.04 * share.sum())
    middle = 0.5 * (angle[first] + angle[last])
    arc = zone[np.abs(angle - middle) <= np.deg2rad(60.0)]
    return Edge(zone=zone, arc=arc, flank=(int(zone[first]), int(zone[last])))


def edge_radius(curve_mm: Floats, arc: Ints) -> Estimate:
    """Radius of the least-squares circle through the nodes `arc` of an edge, every mm weighing the same.

    `arc` spans +-60 deg of the nominal rounding (`edge`). Raises `CannotMeasure` for an edge that is flat.
    """
    points = curve_mm[arc]
    weight = node_shares(curve_mm)[arc]
    middle = points.mean(axis=0)
    x = points - middle
    ones = np.ones(len(x))
    root = np.sqrt(weight)
    start = np.linalg.lstsq(np.column_stack([2.0 * x, ones]) * root[:, None], (x * x).sum(axis=1) * root)[0]
    centre = start[:2]
    for _ in range(20):
        ray = x - centre
        length = np.linalg.norm(ray, axis=1)
        columns = np.column_stack([ones, ray / length[:, None]])
        normal = columns.T @ (columns * weight[:, None])
        if not np.linalg.cond(normal) < 1e12:
            raise CannotMeasure("the edge has no rounding")
        pull = np.linalg.solve(normal, columns.T * weight)
        radius = float(weight @ length / weight.sum())
        step = pull @ (length - radius)
        centre = centre + step[1:]
        if float(np.abs(step).max()) < 1e-10:
            break
    gradient = np.zeros(len(curve_mm))
    gradient[arc] = pull[0]
    return Estimate(value=radius + float(step[0]), gradient=gradient)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CamberLine:
    """Inscribed circles along the mean camber line, from the leading to the trailing edge."""

    centre_mm: Floats  # (k, 2)
    radius_mm: Floats  # (k,)
    node: Ints  # (k,) touched on the side that runs from the trailing to the leading edge
    contact: Ints  # (k,) touched across


def camber_line(curve_mm: Floats, le: int) -> CamberLine:
    """The mean camber line of a curve whose trailing edge is node 0 and whose leading edge is node `le`.

    Within 2 % of the perimeter of either edge there are no circles: an edge's rounding has one only.
    """
    share = node_shares(curve_mm)
    arc = np.cumsum(share) - share[0]
    margin = 0.02 * share.sum()
    node = np.flatnonzero((arc > margin) & (arc < arc[le] - margin))[::-1].copy()
    across = np.flatnonzero((arc > arc[le] + margin) & (arc < share.sum() - margin))
    normals = outward_normals(curve_mm)
    radius, contact = inscribed_circles(curve_mm, normals, node, across)
    centre = curve_mm[node] - radius[:, None] * normals[node]
    return CamberLine(centre_mm=centre, radius_mm=radius, node=node, contact=contact)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pair:
    """Nodes on the first side of the section, and nodes on the second side across from them."""

    node: Ints
    across: Ints


def thick_part(camber: CamberLine) -> Pair:
    """Where a nominal is at least 95 % of its maximum thickness."""
    near = camber.radius_mm >= 0.95 * camber.radius_mm.max()
    return Pair(node=np.sort(camber.node[near]), across=_span(camber.contact[near]))


def _span(nodes: Ints) -> Ints:
    """The nodes from the first to the last, and a few more on both sides."""
    return np.arange(nodes.min() - 20, nodes.max() + 21)


def thickness(curve_mm: Floats, pair: Pair) -> Estimate:
    """Diameter of the largest inscribed circle that touches the curve in nodes of the pair.

    Where the sides are not parallel it grows with the slope in its node, too.
    """
    normals = outward_normals(curve_mm)
    radius, contact = inscribed_circles(curve_mm, normals, pair.node, pair.across)
    best = int(np.argmax(radius))
    node, across = pair.node[best], contact[best]
    wedge = -float(normals[node] @ normals[across])  # 1 where the two sides are parallel
    gradient = np.zeros(len(curve_mm))
    gradient[[node, across]] = 2.0 * wedge / (1.0 + wedge), 2.0 / (1.0 + wedge)
    before, after = node - 1, (node + 1) % len(curve_mm)
    along, chord = curve_mm[after] - curve_mm[before], curve_mm[across] - curve_mm[node]
    tilt = 2.0 * float(radius[best]) * float(chord @ along) / float(chord @ normals[node])
    gradient[after] += tilt / float(along @ along)
    gradient[before] -= tilt / float(along @ along)
    return Estimate(value=2.0 * float(radius[best]), gradient=gradient)


def gauge(camber: CamberLine, from_mm: Floats, along: Floats, distance_mm: float, around: int = 0) -> Pair:
    """The pair of the nominal circle whose centre is `distance_mm` from a point along a direction, and of so
    many `around` it on both sides."""
    near = int(np.argmin(np.abs((camber.centre_mm - from_mm) @ along - distance_mm)))
    some = slice(max(near - around, 0), near + around + 1)
    return Pair(node=camber.node[some], across=_span(camber.contact[some]))
