"""Bitmap letters and shapes of the four verdict words, scaled to whatever room there is."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

Bitmap = NDArray[np.bool_]

_LETTERS: Final = {
    "A": "01110 11011 11011 11111 11011 11011 11011",
    "C": "01111 11000 11000 11000 11000 11000 01111",
    "D": "11110 11011 11011 11011 11011 11011 11110",
    "E": "11111 11000 11000 11110 11000 11000 11111",
    "H": "11011 11011 11011 11111 11011 11011 11011",
    "I": "11 11 11 11 11 11 11",
    "L": "11000 11000 11000 11000 11000 11000 11111",
    "O": "01110 11011 11011 11011 11011 11011 01110",
    "P": "11110 11011 11011 11110 11000 11000 11000",
    "R": "11110 11011 11011 11110 11110 11011 11011",
    "S": "01111 11000 11000 01110 00011 00011 11110",
}
_SHAPES: Final = {
    "PASS": "00000000011 00000000111 00000001110 11000011100 11100111000 01111110000 00111100000 00011000000",
    "REPAIR": "000000110000 000001111000 000001111000 000011111100 "
    "000111111110 000111111110 001111111111 011111111111",
    "SCRAP": "1100000011 0110000110 0011001100 0001111000 0001111000 0011001100 0110000110 1100000011",
    "HOLD": "0011111100 0111001110 0110000110 0000001110 0000111000 0000110000 0000000000 0000110000",
}
GAP: Final = 3


def _bitmap(rows: str) -> Bitmap:
    return np.array([[character == "1" for character in row] for row in rows.split()])


def _word(text: str) -> Bitmap:
    columns = [np.pad(_bitmap(_LETTERS[letter]), ((0, 1), (0, 1))) for letter in text]
    return np.hstack(columns)[:, :-1]


def verdict_bitmap(verdict: str, width: int, height: int) -> Bitmap:
    """The shape and the word of a verdict, as large as fits into (height, width) pixels, centred.

    Where not even the smallest size fits, the picture has no letters; the caller writes the word."""
    shape, word = _bitmap(_SHAPES[verdict]), _word(verdict)
    glyph = np.hstack([shape, np.zeros((8, GAP), dtype=bool), word])
    scale = min(width // (glyph.shape[1] + 4), height // (glyph.shape[0] + 2))
    picture = np.zeros((height, width), dtype=bool)
    if scale >= 1:
        large = np.kron(glyph, np.ones((scale, scale), dtype=bool)).astype(bool)
        top, left = (height - large.shape[0]) // 2, (width - large.shape[1]) // 2
        picture[top : top + large.shape[0], left : left + large.shape[1]] = large
    return picture
