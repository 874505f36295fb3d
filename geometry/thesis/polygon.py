"""Thinned points without order -> the closed polygon through them: thesis 4.3.3."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from geometry.errors import CannotMeasure
from geometry.types import Floats, Ints

_NEAR = 16  # neighbours among which a point finds the nearest on either side of its normal
_LEAST_SHARE = 0.8  # of the points, that the loop must hold


def order_points(points_mm: Floats, normals: Floats) -> Ints:
    """Indices (k,) of the points in their order around the profile; those left out belong to no polygon.

    Points (n, 2) with unit normals (n, 2) of either sign. Raises `CannotMeasure` where they do not close.
    """
    polygon = Polygon.through(points_mm, normals)
    polygon.modify_imperfect_nodes()
    loop = polygon.longest_loop()
    if not len(loop) >= _LEAST_SHARE * len(points_mm):
        raise CannotMeasure(
            f"only {len(loop)} of {len(points_mm)} points of the section make a closed profile"
        )
    return np.array(loop)


def _adjoined(points_mm: Floats, normals: Floats) -> Ints:
    """(n, 2): the nearest point on either side of each normal, -1 where there is none near."""
    near = cKDTree(points_mm).query(points_mm, k=min(_NEAR, len(points_mm)))[1].astype(np.int64)[:, 1:]
    tangents = np.column_stack([normals[:, 1], -normals[:, 0]])
    ahead = np.einsum("nkj,nj->nk", points_mm[near] - points_mm[:, None], tangents) >= 0.0
    sides = []
    for side in (ahead, ~ahead):
        first = near[np.arange(len(near)), side.argmax(axis=1)]
        sides.append(np.where(side.any(axis=1), first, -1))
    return np.column_stack(sides)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Polygon:
    """Nodes with their normals, and the edges between them: `joined[i]` are the nodes that node i meets."""

    points_mm: Floats
    normals: Floats
    joined: list[set[int]]

    @classmethod
    def through(cls, points_mm: Floats, normals: Floats) -> "Polygon":
        """Every point joined with the nearest one on either side of its normal: thesis 4.3.3.1."""
        joined: list[set[int]] = [set() for _ in points_mm]
        for i, pair in enumerate(_adjoined(points_mm, normals).tolist()):
            for j in pair:
                if j >= 0:
                    joined[i].add(j)
                    joined[j].add(i)
        return cls(points_mm=points_mm, normals=normals, joined=joined)

    def modify_imperfect_nodes(self) -> None:
        """Leave no node more than two edges: thesis 4.3.3.2.

        Nodes go by the range of their edges' angular deviations, the widest first; each keeps on either side
        of its normal the edge that deviates least from its tangent. What then hangs by one edge is removed.
        """
        imperfect = {i: self._deviations(i) for i, met in enumerate(self.joined) if len(met) > 2}
        ranges = {i: np.ptp([angle for angle, _, _ in found]) for i, found in imperfect.items()}
        for i in sorted(ranges, key=lambda node: (-ranges[node], node)):
            if len(self.joined[i]) <= 2:
                continue
            least = {ahead: j for _, ahead, j in sorted(self._deviations(i), reverse=True)}
            redundant = self.joined[i] - set(least.values())
            for j in redundant:
                self._cut(i, j)
            self._remove_hanging(redundant)

    def _deviations(self, i: int) -> list[tuple[float, bool, int]]:
        """Angle (rad) to the tangent, side and far node of each edge of node i: thesis equation 4.8."""
        far = sorted(self.joined[i])
        edges = self.points_mm[far] - self.points_mm[i]
        along = edges @ np.array([self.normals[i, 1], -self.normals[i, 0]])
        cosine = np.abs(along) / np.maximum(np.linalg.norm(edges, axis=1), 1e-300)
        angles = np.arccos(np.minimum(cosine, 1.0))
        return list(zip(angles.tolist(), (along >= 0.0).tolist(), far, strict=True))

    def _cut(self, i: int, j: int) -> None:
        self.joined[i].discard(j)
        self.joined[j].discard(i)

    def _remove_hanging(self, nodes: Iterable[int]) -> None:
        """Remove the nodes that have one edge only, and those that come to hang by it."""
        waiting = list(nodes)
        while waiting:
            i = waiting.pop()
            if len(self.joined[i]) == 1:
                (j,) = self.joined[i]
                self._cut(i, j)
                waiting.append(j)

    def longest_loop(self) -> list[int]:
        """The nodes of the closed loop of most nodes, in order; none where nothing closes."""
        best: list[int] = []
        seen: set[int] = set()
        for start in range(len(self.joined)):
            if start not in seen:
                path, closed = self._walk(start)
                seen.update(path)
                if closed and len(path) > len(best):
                    best = path
        return best

    def _walk(self, start: int) -> tuple[list[int], bool]:
        """The nodes from `start` along the edges until there is none further, and whether they close."""
        path, before, here = [start], -1, start
        while True:
            further = sorted(self.joined[here] - {before})
            if not further:
                return path, False
            before, here = here, further[0]
            if here == start:
                return path, len(path) > 2
            path.append(here)
