"""XYZ, ASC and CSV text: one point a line, x y z first or under these names."""

import re

from geometry.types import Floats
from station.formats.malformed import Malformed, numbers

COMMENTS = (b"#", b"//")


def text_points(content: bytes) -> Floats:
    """The points (n, 3) as they stand in the file; raises `Malformed`.

    Columns are separated by semicolons, commas or blanks, whichever the first row has. With semicolons a
    comma is a decimal comma. A row that is no number names the columns."""
    if b"\0" in content[:4096]:
        raise Malformed("not a text file")
    rows = [row for row in content.splitlines() if row.strip() and not row.lstrip().startswith(COMMENTS)]
    if not rows:
        return numbers(rows, None)
    delimiter = next((mark for mark in (";", ",") if mark.encode() in rows[0]), None)
    titles = split(rows[0], delimiter)
    named = not is_number(titles[0])
    columns = named_columns(titles) if named else [0, 1, 2]
    rows = rows[1:] if named else rows
    if delimiter == ";":
        rows = [row.replace(b",", b".") for row in rows]
    return numbers(rows, columns, delimiter)


def split(row: bytes, delimiter: str | None) -> list[str]:
    """The words of a row, at least one: bytes that are blank only as characters make an empty one."""
    return [word.strip(" \t\"'") for word in row.decode("latin-1").split(delimiter)] or [""]


def is_number(word: str) -> bool:
    try:
        float(word.replace(",", "."))
    except ValueError:
        return False
    return True


def named_columns(titles: list[str]) -> list[int]:
    """The columns that are called x, y and z, alone or with a unit: x_mm, X [mm]."""
    return [named_column([title.lower() for title in titles], axis) for axis in "xyz"]


def named_column(titles: list[str], axis: str) -> int:
    """The one column of an axis; raises `Malformed` where there is none, or more than one."""
    plain = [i for i, title in enumerate(titles) if title == axis]
    named = plain or [i for i, title in enumerate(titles) if re.match(rf"{axis}(?![a-z])", title)]
    if not named:
        raise Malformed("the first row is neither numbers nor the names x, y, z")
    if len(named) > 1:
        raise Malformed(f"columns {' and '.join(str(i + 1) for i in named)} are both called {axis}")
    return named[0]
