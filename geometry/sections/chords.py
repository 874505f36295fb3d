"""The chords of a section: caliper, nose to tail, and tangent; each with its growth.

Curves (m, 2) are closed, counter-clockwise, with the nodes of the nominal one.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from geometry.errors import CannotMeasure
from geometry.kernels.airfoil import farthest_pair
from geometry.sections.chart import outward_normal
from geometry.sections.curve import Edge, Estimate
from geometry.types import Floats, Ints

_SETTLED_MM = 1e-9  # what moves less, end or unit direction, has settled


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Contact:
    """Where a line across `direction` touches an edge from outside."""

    node: int
    point_mm: Floats
    radius_mm: float  # of curvature
    slope: Floats  # (m,): weights that give the slope of a node function along the arc there ...
    steepness: Floats  # (m,): ... and in the node itself


def touch(curve_mm: Floats, node: int, direction: Floats) -> Contact:
    """The contact near `node`, between nodes, by a parabola through 17 of them."""
    m = len(curve_mm)
    near = (node + np.arange(-8, 9)) % m
    points = curve_mm[near]
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    arc -= arc[8]
    basis = np.column_stack([np.ones(17), arc, arc * arc])
    inverse = np.linalg.solve(basis.T @ basis, basis.T)
    _, linear, square = inverse @ (points @ direction)
    curvature = -2.0 * float(square)
    reach = float(arc[-1])
    at = float(np.clip(linear / curvature, arc[0], reach)) if curvature > 1e-9 else 0.0
    place = np.array([1.0, at, at * at]) @ inverse @ points
    slope, steepness = np.zeros(m), np.zeros(m)
    slope[near], steepness[near] = inverse[1] + 2.0 * at * inverse[2], inverse[1]
    radius = 1.0 / max(curvature, 1.0 / 50.0)
    return Contact(node=node, point_mm=place, radius_mm=radius, slope=slope, steepness=steepness)


def _farthest(curve_mm: Floats, nodes: Ints, direction: Floats) -> Contact:
    """The contact of the node of `nodes` that lies farthest along the direction."""
    return touch(curve_mm, int(nodes[np.argmax(curve_mm[nodes] @ direction)]), direction)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Line:
    """A straight line from nose to tail, its length (mm), and how its ends move with each node."""

    length: Estimate
    nose_mm: Floats
    tail_mm: Floats
    nose_growth: Floats  # (2, m)
    tail_growth: Floats  # (2, m)

    @property
    def along(self) -> Floats:
        """Unit vector from nose to tail."""
        ends = self.tail_mm - self.nose_mm
        along: Floats = ends / np.linalg.norm(ends)
        return along


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chord:
    """The caliper chord and its angle (rad, of nose to tail against +X)."""

    line: Line
    stagger: Estimate


def chord(curve_mm: Floats, le: Edge, te: Edge) -> Chord:
    """The caliper chord: the largest distance between two points of the section (largest Feret diameter).

    Its ends lie in the zones of the two edges; the nose is the one at the leading edge.
    """
    nose, tail = farthest_pair(curve_mm, le.zone, te.zone)
    ends = curve_mm[tail] - curve_mm[nose]
    for _ in range(4):
        along = ends / np.linalg.norm(ends)
        front, back = touch(curve_mm, nose, -along), touch(curve_mm, tail, along)
        before, ends = ends, back.point_mm - front.point_mm
        if np.abs(ends - before).max() < _SETTLED_MM:
            break
    length = float(np.linalg.norm(ends))
    lever = length - front.radius_mm - back.radius_mm
    swing = (back.radius_mm * back.slope + front.radius_mm * front.slope) / lever
    angle = float(np.arctan2(ends[1], ends[0]))
    line = _between((front, _moved(curve_mm, front)), (back, _moved(curve_mm, back)))
    return Chord(line=line, stagger=Estimate(value=angle, gradient=swing))


def _moved(curve_mm: Floats, contact: Contact) -> Floats:
    """(2, m): how a contact moves with each node, along the normal, while its direction stays."""
    normal = outward_normal(curve_mm, contact.node)
    moved = np.outer([-normal[1], normal[0]], contact.radius_mm * contact.slope)
    moved[:, contact.node] += normal
    return moved


def _between(front: tuple[Contact, Floats], back: tuple[Contact, Floats]) -> Line:
    """The line between two contacts that come with their movements."""
    (nose, nose_growth), (tail, tail_growth) = front, back
    ends = tail.point_mm - nose.point_mm
    length = float(np.linalg.norm(ends))
    return Line(
        length=Estimate(value=length, gradient=ends @ (tail_growth - nose_growth) / length),
        nose_mm=nose.point_mm,
        tail_mm=tail.point_mm,
        nose_growth=nose_growth,
        tail_growth=tail_growth,
    )


def nose_tail_chord(curve_mm: Floats, le: Edge, te: Edge) -> Line:
    """The chord from nose to tail: the points of the two edges that lie farthest along their own directions.

    An edge points halfway between its sides, 4 % of the perimeter away (`edge`): on a round one, nose and
    tail are where the mean camber line, carried on straight from there, leaves the section.
    """
    return _between(_tip(curve_mm, le), _tip(curve_mm, te))


def _tip(curve_mm: Floats, end: Edge) -> tuple[Contact, Floats]:
    """The point of an edge farthest along its own direction, and how it moves: that direction turns too."""
    contact = _farthest(curve_mm, end.zone, end.direction(curve_mm))
    moved = _moved(curve_mm, contact)
    normal = outward_normal(curve_mm, contact.node)
    turn = sum(0.5 * touch(curve_mm, node, normal).steepness for node in end.flank)
    return contact, moved - np.outer([-normal[1], normal[0]], contact.radius_mm * turn)


def hollow(nominal_mm: Floats, le: Edge, te: Edge) -> Floats:
    """The direction (2,) out of the hollow side of a nominal.

    A side is hollow if a side of the convex hull bridges it from edge to edge. Raises `CannotMeasure` for a
    section without one: no straight edge rests on it.
    """
    hull = ConvexHull(nominal_mm)
    ends = nominal_mm[hull.simplices]
    longest = int(np.argmax(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)))
    pair = hull.simplices[longest]
    if not (np.isin(pair, le.zone).any() and np.isin(pair, te.zone).any()):
        raise CannotMeasure("the section has no hollow side to rest on")
    out: Floats = hull.equations[longest, :2]
    return out


def tangent_chord(curve_mm: Floats, le: Edge, te: Edge, down: Floats) -> Estimate:
    """The tangent chord: the length of the section along the straight edge on which its hollow side rests.

    `down` (2,) points out of the hollow side of the nominal.
    """
    front, back = le.zone, te.zone
    for _ in range(6):
        one = _farthest(curve_mm, front, down)
        other = _farthest(curve_mm, back, down)
        line = other.point_mm - one.point_mm
        line = line / np.linalg.norm(line)
        turned = np.array([line[1], -line[0]])
        before, down = down, turned if float(turned @ down) > 0.0 else -turned
        if np.abs(down - before).max() < _SETTLED_MM:
            break
    nose, tail = _farthest(curve_mm, front, -line), _farthest(curve_mm, back, line)
    gradient = np.zeros(len(curve_mm))
    gradient[nose.node] -= float(outward_normal(curve_mm, nose.node) @ line)
    gradient[tail.node] += float(outward_normal(curve_mm, tail.node) @ line)
    ends = tail.point_mm - nose.point_mm
    lean = float(ends @ down) / float(np.linalg.norm(other.point_mm - one.point_mm))
    gradient[other.node] += lean * float(outward_normal(curve_mm, other.node) @ down)
    gradient[one.node] -= lean * float(outward_normal(curve_mm, one.node) @ down)
    return Estimate(value=float(ends @ line), gradient=gradient)
