"""Pixel and dot buffers to Textual strips: half blocks, braille, and plain ASCII for poor terminals."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from rich.color import Color
from rich.color_triplet import ColorTriplet
from rich.segment import Segment
from rich.style import Style
from textual.strip import Strip
from textual.widget import Widget

from station.tui.palette import FIELD, Pixels

Dots = NDArray[np.bool_]

_BRAILLE_BITS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]], dtype=np.uint32)
_ASCII_SHADES = " .:*#"


@lru_cache(maxsize=1 << 15)
def style(foreground: int, background: int) -> Style:
    """A cached style of two 0xRRGGBB colours."""
    return Style.from_color(_color(foreground), _color(background))


def _color(value: int) -> Color:
    return Color.from_triplet(ColorTriplet(value >> 16, (value >> 8) & 0xFF, value & 0xFF))


def half_blocks(pixels: Pixels) -> list[Strip]:
    """Strips of a (2 rows, columns) pixel image: two pixels a cell, each in its own colour."""
    top, bottom = pixels[0::2], pixels[1::2]
    return [_half_block_row(upper, lower) for upper, lower in zip(top, bottom, strict=True)]


def _half_block_row(upper: Pixels, lower: Pixels) -> Strip:
    key = (upper.astype(np.uint64) << np.uint64(32)) | lower
    segments = [
        Segment((" " if upper[a] == lower[a] else "▀") * (b - a), style(int(upper[a]), int(lower[a])))
        for a, b in _runs(key)
    ]
    return Strip(segments, len(upper))


def ascii_shades(pixels: Pixels) -> list[Strip]:
    """The same image in `.:*#` by brightness, for terminals without block glyphs."""
    red, green, blue = ((pixels >> shift) & 0xFF for shift in (16, 8, 0))
    bright = (2 * red + 5 * green + blue).astype(np.float64) / (8 * 255)
    bright[pixels == FIELD] = 0.0
    level = np.maximum(bright[0::2], bright[1::2])
    index = np.minimum((level * len(_ASCII_SHADES)).astype(int), len(_ASCII_SHADES) - 1)
    return [Strip([Segment("".join(_ASCII_SHADES[i] for i in row))], len(row)) for row in index]


def braille(dots: Dots, colours: Pixels) -> list[Strip]:
    """Strips of (4 rows, 2 columns) dots with one colour a cell, (rows, columns)."""
    rows, columns = colours.shape
    cells = dots.reshape(rows, 4, columns, 2)
    code = (cells * _BRAILLE_BITS[None, :, None, :]).sum(axis=(1, 3)).astype(np.uint32)
    return [_braille_row(code[row], colours[row]) for row in range(rows)]


def _braille_row(code: Pixels, colours: Pixels) -> Strip:
    key = np.where(code > 0, colours, FIELD).astype(np.uint64)
    text = [chr(0x2800 + int(value)) if value else " " for value in code]
    segments = [Segment("".join(text[a:b]), style(int(key[a]), FIELD)) for a, b in _runs(key)]
    return Strip(segments, len(code))


def ascii_dots(dots: Dots) -> list[Strip]:
    """The same dots with `#` where a cell has any, for terminals without braille."""
    rows, columns = dots.shape[0] // 4, dots.shape[1] // 2
    filled = np.where(dots.reshape(rows, 4, columns, 2).any(axis=(1, 3)), "#", " ")
    return [Strip([Segment("".join(row))], columns) for row in filled]


def _runs(key: NDArray[np.uint64]) -> list[tuple[int, int]]:
    cuts = np.flatnonzero(key[1:] != key[:-1]) + 1
    starts = [0, *cuts.tolist()]
    return list(zip(starts, [*starts[1:], len(key)], strict=True)) if len(key) else []


class Canvas(Widget):
    """A widget drawn as strips, rebuilt once per change and served line by line.

    An exception while drawing must not end the application: it becomes one line of text."""

    glyphs: str = "blocks"

    def __init__(self, *, id: str | None = None, classes: str | None = None) -> None:  # noqa: A002
        super().__init__(id=id, classes=classes)
        self._strips: list[Strip] | None = None

    def draw(self, columns: int, rows: int) -> list[Strip]:
        """Strips for the present size, which each canvas draws; no ABC beside a widget's metaclass."""
        raise NotImplementedError

    def redraw(self) -> None:
        """Drop what was drawn: the data or the size changed."""
        self._strips = None
        self.refresh()

    def on_resize(self) -> None:
        self.redraw()

    def render_line(self, y: int) -> Strip:
        if self._strips is None:
            self._strips = self._drawn()
        blank = Strip.blank(self.size.width, self.visual_style.rich_style)
        return self._strips[y] if y < len(self._strips) else blank

    def _drawn(self) -> list[Strip]:
        columns, rows = self.size
        if not (columns and rows):
            return []
        try:
            return self.draw(columns, rows)
        except Exception as error:  # a drawing fault costs this picture, never the screen
            text = f"cannot draw {type(self).__name__}: {error}"[:columns]
            return [Strip([Segment(text)], len(text)).adjust_cell_length(columns)]
