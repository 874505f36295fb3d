"""XYZ, ASC and CSV text: one point a line, x y z first or under these names."""

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
    """The columns whose titles begin with x, y and z."""
    initials = [title[:1].lower() for title in titles]
    if not all(axis in initials for axis in "xyz"):
        raise Malformed("the first row is neither numbers nor the names x, y, z")
    return [initials.index(axis) for axis in "xyz"]
