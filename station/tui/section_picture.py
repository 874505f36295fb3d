"""One section as braille dots with equal aspect: nominal, limit band, measured profile magnified."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from station.events import SectionMeasured, unpack
from station.tui.canvas import Dots
from station.tui.palette import DIM, FAINT, INK, OVER, UNDER, Pixels, band_colours

Floats = NDArray[np.float64]
WHISKER_DOTS = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """What part of the section plane is shown, and how many times deviations are magnified."""

    centre_mm: tuple[float, float]
    half_width_mm: float
    half_height_mm: float
    magnification: float


class Dotted:
    """A braille image in the making: dots, and in each cell the colour of the most important one."""

    def __init__(self, columns: int, rows: int) -> None:
        self.dots: Dots = np.zeros((4 * rows, 2 * columns), dtype=bool)
        self.colours: Pixels = np.full((rows, columns), INK, dtype=np.uint32)
        self._rank = np.full((rows, columns), -1, dtype=np.int64)

    def put(self, x: Floats, y: Floats, colours: Pixels, rank: int) -> None:
        """Dots at (x, y) in dot units, y downwards; a higher rank wins the colour of a cell."""
        column, row = np.rint(x).astype(np.int64), np.rint(y).astype(np.int64)
        inside = (column >= 0) & (column < self.dots.shape[1]) & (row >= 0) & (row < self.dots.shape[0])
        column, row, colours = column[inside], row[inside], colours[inside]
        self.dots[row, column] = True
        cell = (row // 4, column // 2)
        wins = rank >= self._rank[cell]
        self.colours[row[wins] // 4, column[wins] // 2] = colours[wins]
        self._rank[row[wins] // 4, column[wins] // 2] = rank


def whole(section: SectionMeasured) -> Window:
    """The window that shows the whole section with its magnified deviations."""
    nominal_mm = unpack(section.nominal_mm, 2)
    low, high = nominal_mm.min(axis=0), nominal_mm.max(axis=0)
    size = float((high - low).max())
    magnification = max(1.0, 0.06 * size / _reach_mm(section))
    pad = 0.09 * size
    centre = (low + high) / 2.0
    half = (high - low) / 2.0 + pad
    return Window(
        centre_mm=(float(centre[0]), float(centre[1])),
        half_width_mm=float(half[0]),
        half_height_mm=float(half[1]),
        magnification=magnification,
    )


def around(section: SectionMeasured, centre_mm: tuple[float, float], half_mm: float) -> Window:
    """The window of an edge."""
    return Window(
        centre_mm=centre_mm,
        half_width_mm=half_mm,
        half_height_mm=half_mm,
        magnification=max(1.0, 0.12 * half_mm / _reach_mm(section)),
    )


def _reach_mm(section: SectionMeasured) -> float:
    deviation_mm = unpack(section.deviation_mm)
    largest = float(np.abs(deviation_mm).max()) if len(deviation_mm) else 0.0
    return max(min(largest, 3.0 * (section.serviceable_mm or largest)), section.serviceable_mm or 0.0, 1e-3)


def section_dots(section: SectionMeasured, window: Window, columns: int, rows: int) -> Dotted:
    """The section drawn into (rows, columns) cells; no line crosses a gap of the measured profile."""
    image = Dotted(columns, rows)
    scale = min(columns / window.half_width_mm, 2.0 * rows / window.half_height_mm)

    def place(points_mm: Floats) -> tuple[Floats, Floats]:
        x = columns + (points_mm[:, 0] - window.centre_mm[0]) * scale
        return x, 2.0 * rows - (points_mm[:, 1] - window.centre_mm[1]) * scale

    nominal_mm = unpack(section.nominal_mm, 2).astype(np.float64)
    normal = _outward(nominal_mm)
    limit_mm = section.serviceable_mm
    if limit_mm:
        for sign in (-1.0, 1.0):
            band_mm = nominal_mm + sign * limit_mm * window.magnification * normal
            _draw(image, *place(_closed(band_mm)), FAINT, 1, dash=6.0)
    _draw(image, *place(_closed(nominal_mm)), DIM, 2)
    profile_mm = unpack(section.profile_mm, 2).astype(np.float64)
    if not len(profile_mm):
        return image
    deviation_mm, run = unpack(section.deviation_mm), unpack(section.run)
    foot_mm, outward = _feet(profile_mm, nominal_mm, normal)
    shown_mm = foot_mm + outward * (deviation_mm.astype(np.float64) * window.magnification)[:, None]
    colours = band_colours(deviation_mm, limit_mm or float(np.abs(deviation_mm).max()) or 1.0)
    _whiskers(image, place(foot_mm), place(shown_mm), colours)
    for number in np.unique(run):
        chosen = run == number
        x, y = place(shown_mm[chosen])
        _draw_coloured(image, x, y, colours[chosen])
    return image


def _closed(curve: Floats) -> Floats:
    return np.concatenate([curve, curve[:1]])


def _outward(curve_mm: Floats) -> Floats:
    """Unit outward normals (m, 2) of a counter-clockwise closed curve."""
    tangent = np.roll(curve_mm, -1, axis=0) - np.roll(curve_mm, 1, axis=0)
    normal = np.column_stack([tangent[:, 1], -tangent[:, 0]])
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


def _feet(points_mm: Floats, curve_mm: Floats, normal: Floats) -> tuple[Floats, Floats]:
    """For each point the nearest vertex of the curve and its normal; curves here have a few hundred."""
    nearest = np.empty(len(points_mm), dtype=np.int64)
    for start in range(0, len(points_mm), 512):
        block = points_mm[start : start + 512]
        distance = ((block[:, None] - curve_mm[None]) ** 2).sum(axis=2)
        nearest[start : start + 512] = distance.argmin(axis=1)
    return curve_mm[nearest], normal[nearest]


def _draw(image: Dotted, x: Floats, y: Floats, colour: int, rank: int, dash: float = 0.0) -> None:
    """A polyline of one colour, resampled to about one dot a step; dashed by arc length."""
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    if not arc[-1] > 0.0:
        return
    at = np.arange(0.0, arc[-1], 0.8)
    if dash:
        at = at[(at // dash).astype(int) % 2 == 0]
    image.put(np.interp(at, arc, x), np.interp(at, arc, y), np.full(len(at), colour, dtype=np.uint32), rank)


def _draw_coloured(image: Dotted, x: Floats, y: Floats, colours: Pixels) -> None:
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    at = np.arange(0.0, arc[-1] + 0.4, 0.8)
    nearest = np.clip(np.searchsorted(arc, at), 0, len(arc) - 1)
    inside = ~np.isin(colours[nearest], (OVER, UNDER))
    for chosen, rank in ((inside, 4), (~inside, 6)):
        image.put(
            np.interp(at, arc, x)[chosen], np.interp(at, arc, y)[chosen], colours[nearest][chosen], rank
        )


def _whiskers(
    image: Dotted, foot: tuple[Floats, Floats], end: tuple[Floats, Floats], colours: Pixels
) -> None:
    """Lines from the nominal to the measured profile, one every few dots."""
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(foot[0]), np.diff(foot[1])))])
    chosen = np.unique(np.searchsorted(arc, np.arange(0.0, arc[-1], WHISKER_DOTS)))
    step = np.linspace(0.0, 1.0, 24)[None]
    x = foot[0][chosen, None] + (end[0] - foot[0])[chosen, None] * step
    y = foot[1][chosen, None] + (end[1] - foot[1])[chosen, None] * step
    image.put(x.ravel(), y.ravel(), np.repeat(colours[chosen], step.size), 3)
