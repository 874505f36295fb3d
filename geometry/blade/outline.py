"""Closed planar curves: length, area, refinement, and the two ends of an airfoil."""

from dataclasses import dataclass

import numpy as np

from geometry.errors import BadMesh
from geometry.types import Floats


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Outline:
    """A closed planar polyline, first point not repeated, with a unit outward normal a point."""

    points_mm: Floats  # (m, 2)
    normals: Floats  # (m, 2)


@dataclass(frozen=True, slots=True, kw_only=True)
class End:
    """One end of an airfoil outline: where its camber line leaves it, and the width just inside."""

    index: int
    point_mm: tuple[float, float]
    width_mm: float


def area(points_mm: Floats) -> float:
    """Signed area, mm2: positive counter-clockwise."""
    x, y = (points_mm - points_mm[0]).T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def arc_length(points_mm: Floats) -> tuple[Floats, float]:
    """Arc length (m,) from the first point to each point, and the perimeter."""
    step_mm = np.linalg.norm(np.roll(points_mm, -1, axis=0) - points_mm, axis=1)
    along_mm = np.concatenate([[0.0], np.cumsum(step_mm)])
    return along_mm[:-1], float(along_mm[-1])


def refine(start_mm: Floats, start_normal: Floats, end_normal: Floats, step_mm: float) -> Outline:
    """The polyline through `start_mm` (m, 2) with points added so that none is further than `step_mm` on.

    Segment i runs from point i to the next; its normal turns evenly from `start_normal[i]` to
    `end_normal[i]`. At a given point the normals of both its segments are averaged.
    """
    stop_mm = np.roll(start_mm, -1, axis=0)
    pieces = np.maximum(1, np.ceil(np.linalg.norm(stop_mm - start_mm, axis=1) / step_mm)).astype(np.int64)
    segment = np.repeat(np.arange(len(start_mm)), pieces)
    first = np.concatenate([[0], np.cumsum(pieces)[:-1]])
    t = ((np.arange(len(segment)) - first[segment]) / pieces[segment])[:, None]
    normals = (1.0 - t) * start_normal[segment] + t * end_normal[segment]
    normals[first] = start_normal + np.roll(end_normal, 1, axis=0)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points_mm = (1.0 - t) * start_mm[segment] + t * stop_mm[segment]
    return Outline(points_mm=points_mm, normals=normals)


def start_at(outline: Outline, index: int) -> Outline:
    """The same curve with another first point."""
    return Outline(
        points_mm=np.roll(outline.points_mm, -index, axis=0), normals=np.roll(outline.normals, -index, axis=0)
    )


def farthest_pair(points_mm: Floats) -> tuple[int, int]:
    """Indices of two points nearly as far apart as any: of every n-th point, in directions 1 degree apart."""
    thinned = np.arange(0, len(points_mm), max(1, len(points_mm) // 400))
    angle_rad = np.deg2rad(np.arange(0.0, 180.0, 1.0))
    along = points_mm[thinned] @ np.stack([np.cos(angle_rad), np.sin(angle_rad)])
    low, high = thinned[along.argmin(axis=0)], thinned[along.argmax(axis=0)]
    best = int(np.linalg.norm(points_mm[high] - points_mm[low], axis=1).argmax())
    return int(low[best]), int(high[best])


def caliper_mm(points_mm: Floats) -> float:
    """The largest distance between two points."""
    a, b = farthest_pair(points_mm)
    return float(np.linalg.norm(points_mm[a] - points_mm[b]))


def find_ends(outline: Outline) -> tuple[End, End]:
    """The two ends of an airfoil outline, in no particular order.

    They start as the farthest pair of points. Each then moves to the extreme of the curve in the
    direction of the camber line near it, taken through the midpoints of the two sides at equal arc
    distances from the end; the two are repeated until the end stays. Raises `BadMesh` if the ends merge.
    """
    curve = _closed(outline.points_mm)
    first, second = (_settle(curve, index) for index in farthest_pair(outline.points_mm))
    apart_mm = abs(curve.along_mm[first.index] - curve.along_mm[second.index])
    if not 0.25 * curve.perimeter_mm <= apart_mm <= 0.75 * curve.perimeter_mm:
        raise BadMesh(f"no airfoil: both ends of a section fall {apart_mm:.2f} mm apart along its outline")
    return first, second


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Closed:
    """A closed curve with its first point again at the end."""

    points_mm: Floats  # (m + 1, 2)
    along_mm: Floats  # (m + 1,)
    perimeter_mm: float

    def at(self, along_mm: Floats) -> Floats:
        """The points (k, 2) at arc lengths (k,), round and round."""
        around_mm = np.mod(along_mm, self.perimeter_mm)
        return np.column_stack([np.interp(around_mm, self.along_mm, self.points_mm[:, i]) for i in range(2)])


def _closed(points_mm: Floats) -> _Closed:
    along_mm, perimeter_mm = arc_length(points_mm)
    return _Closed(
        points_mm=np.concatenate([points_mm, points_mm[:1]]),
        along_mm=np.append(along_mm, perimeter_mm),
        perimeter_mm=perimeter_mm,
    )


def _settle(curve: _Closed, index: int) -> End:
    count = len(curve.points_mm) - 1
    for _ in range(20):
        inward_mm, outward = _camber(curve, index)
        apart_mm = np.abs(curve.along_mm[:count] - curve.along_mm[index])
        window = np.flatnonzero(
            np.minimum(apart_mm, curve.perimeter_mm - apart_mm) <= 0.05 * curve.perimeter_mm
        )
        settled = int(window[np.argmax((curve.points_mm[window] - inward_mm) @ outward)])
        if settled == index:
            break
        index = settled
    a_mm, b_mm = _sides(curve, index, 0.01)
    x_mm, y_mm = curve.points_mm[index]
    return End(index=index, point_mm=(float(x_mm), float(y_mm)), width_mm=float(np.linalg.norm(a_mm - b_mm)))


def _camber(curve: _Closed, index: int) -> tuple[Floats, Floats]:
    """A camber point near an end and the unit direction of the camber line out through that end."""
    near_mm, far_mm = (_sides(curve, index, fraction).mean(axis=0) for fraction in (0.03, 0.06))
    outward = near_mm - far_mm
    return near_mm, outward / np.linalg.norm(outward)


def _sides(curve: _Closed, index: int, fraction: float) -> Floats:
    """The two points (2, 2) that lie a fraction of the perimeter along the curve to either side of an end."""
    reach_mm = fraction * curve.perimeter_mm
    return curve.at(curve.along_mm[index] + np.array([-reach_mm, reach_mm]))
