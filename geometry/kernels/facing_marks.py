"""Distance from places of a surface to the nearest mark that faces the same way."""

import numpy as np
from numba import njit

from geometry.kernels.neighbours import cell_index, counting_sort, margin
from geometry.kernels.parts import over_parts
from geometry.types import Floats, Ints

MOST_CELLS = 2_000_000


class FacingMarks:
    """Marks on a surface, each with its normal, in a grid of cells about `cell_mm` wide."""

    def __init__(self, points_mm: Floats, normals: Floats, cell_mm: float) -> None:
        if not len(points_mm):
            raise ValueError("a grid of no marks")
        low_mm = points_mm.min(axis=0)
        extent_mm = points_mm.max(axis=0) - low_mm
        cell_mm = max(cell_mm, float(np.cbrt(np.prod(extent_mm + cell_mm) / MOST_CELLS)))
        cells = (extent_mm / cell_mm).astype(np.int64) + 1
        starts, order = counting_sort(cell_index(points_mm, low_mm, cell_mm, cells), int(np.prod(cells)))
        self._known = (points_mm[order], normals[order], starts, low_mm, cell_mm, cells)

    def distance_mm(self, places_mm: Floats, normals: Floats, least_cosine: float) -> Floats:
        """Distance (n,) from each place (n, 3) to the nearest mark whose normal has more than `least_cosine`
        with the place's; infinite where there is none."""
        nearest_mm = np.empty(len(places_mm))
        work = (places_mm, normals, *self._known, least_cosine, nearest_mm)
        over_parts(lambda first, last: nearest_facing(*work, first, last), len(places_mm))
        return nearest_mm


@njit(cache=True, nogil=True)
def nearest_facing(
    places: Floats,
    facing: Floats,
    points: Floats,
    normals: Floats,
    starts: Ints,
    low: Floats,
    cell: float,
    cells: Ints,
    least_cosine: float,
    nearest: Floats,
    first: int,
    last: int,
) -> None:
    """Write `nearest` from place `first` to before `last`: in ever wider shells of cells, until nothing
    nearer can be outside."""
    for i in range(first, last):
        x, y, z = places[i, 0], places[i, 1], places[i, 2]
        a = int(np.floor((x - low[0]) / cell))
        b = int(np.floor((y - low[1]) / cell))
        c = int(np.floor((z - low[2]) / cell))
        whole = max(a, cells[0] - 1 - a, b, cells[1] - 1 - b, c, cells[2] - 1 - c)
        inside = margin(x, y, z, low, cell, a, b, c)
        best, shell = np.inf, 0
        while shell <= whole:
            best = min(
                best,
                _in_shell(x, y, z, facing[i], points, normals, starts, cells, a, b, c, shell, least_cosine),
            )
            if best <= (shell * cell + inside) ** 2:
                break
            shell += 1
        nearest[i] = np.sqrt(best)


@njit(cache=True, nogil=True)
def _in_shell(  # type: ignore[no-untyped-def]
    x, y, z, facing, points, normals, starts, cells, a, b, c, shell, least_cosine
):
    """The least squared distance to a mark that faces alike, in the cells exactly `shell` away."""
    best = np.inf
    for p in range(max(a - shell, 0), min(a + shell, cells[0] - 1) + 1):
        for q in range(max(b - shell, 0), min(b + shell, cells[1] - 1) + 1):
            on_side = abs(p - a) == shell or abs(q - b) == shell
            step = 1 if on_side or shell == 0 else 2 * shell
            for r in range(c - shell, c + shell + 1, step):
                if r < 0 or r >= cells[2]:
                    continue
                own = (p * cells[1] + q) * cells[2] + r
                for j in range(starts[own], starts[own + 1]):
                    dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
                    d2 = dx * dx + dy * dy + dz * dz
                    if d2 < best:
                        cosine = normals[j, 0] * facing[0] + normals[j, 1] * facing[1]
                        if cosine + normals[j, 2] * facing[2] > least_cosine:
                            best = d2
    return best
