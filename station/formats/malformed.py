"""What every reader raises, and how text tables of numbers are read."""

from collections.abc import Sequence

import numpy as np

from geometry.types import Floats


class Malformed(Exception):
    """These bytes are not a file of this format; the text says where and why, on one line."""


def numbers(rows: Sequence[bytes], columns: Sequence[int] | None, delimiter: str | None = None) -> Floats:
    """The numbers of text rows (n, columns); raises `Malformed` for the first that is none."""
    if not rows:
        return np.empty((0, 3))
    try:
        return np.loadtxt(
            rows, dtype=np.float64, comments=None, delimiter=delimiter, usecols=columns, ndmin=2
        )
    except (ValueError, OverflowError) as error:
        raise Malformed(str(error).replace("\n", " ").rstrip(".")) from error
