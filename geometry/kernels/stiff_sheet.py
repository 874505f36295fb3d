"""Segments against a sheet of quadrilaterals."""

import numpy as np
from numba import njit

from geometry.types import Bools, Floats


@njit(cache=True, nogil=True)
def crosses_sheet(starts: Floats, ends: Floats, sheet: Floats) -> Bools:
    """Which segments (n,) from `starts` to `ends` (n, 3) meet the sheet (rows, columns, 3).

    All points of a row share its z, which ascends by rows; each cell of the sheet is two triangles.
    """
    rows, columns = sheet.shape[0], sheet.shape[1]
    crossed = np.zeros(len(starts), np.bool_)
    for i in range(len(starts)):
        low, high = np.minimum(starts[i], ends[i]), np.maximum(starts[i], ends[i])
        for r in range(rows - 1):
            if sheet[r + 1, 0, 2] < low[2] or sheet[r, 0, 2] > high[2]:
                continue
            for c in range(columns - 1):
                if _beside(low, high, sheet, r, c, 0) or _beside(low, high, sheet, r, c, 1):
                    continue
                a, b = sheet[r, c], sheet[r, c + 1]
                d, e = sheet[r + 1, c], sheet[r + 1, c + 1]
                if _meets(starts[i], ends[i], a, b, d) or _meets(starts[i], ends[i], e, d, b):
                    crossed[i] = True
                    break
            if crossed[i]:
                break
    return crossed


@njit(cache=True, nogil=True, inline="always")
def _beside(low, high, sheet, r, c, axis):  # type: ignore[no-untyped-def]
    """A box lies on one side of all four corners of a cell, along one axis."""
    a, b, d, e = sheet[r, c, axis], sheet[r, c + 1, axis], sheet[r + 1, c, axis], sheet[r + 1, c + 1, axis]
    return high[axis] < min(a, b, d, e) or low[axis] > max(a, b, d, e)


@njit(cache=True, nogil=True)
def _meets(start: Floats, end: Floats, a: Floats, b: Floats, c: Floats) -> bool:
    """A segment meets a triangle (Moeller and Trumbore, 1997)."""
    along, first, second = end - start, b - a, c - a
    across = np.cross(along, second)
    det = np.dot(first, across)
    if det == 0.0:
        return False
    offset = start - a
    u = np.dot(offset, across) / det
    turned = np.cross(offset, first)
    v = np.dot(along, turned) / det
    t = np.dot(second, turned) / det
    return u >= 0.0 and v >= 0.0 and u + v <= 1.0 and 0.0 <= t <= 1.0
