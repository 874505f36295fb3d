"""Measurement files in, points out: PLY, PCD, XYZ/ASC/CSV text, E57. The file's ending names the format.

Total: any bytes give a `Scan` or a `BadScan` whose text is one line. What a header declares is held
against the bytes that are there before anything is allocated for it, and a file that is longer or shorter
than its header says is refused: a truncated scan must never become half a blade.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from geometry.types import Bools, Floats
from station.formats.e57 import e57_points
from station.formats.malformed import Malformed
from station.formats.pcd import pcd_points
from station.formats.ply import ply_points
from station.formats.text import text_points
from station.refusal import Refusal

MAX_BYTES = 1 << 30
FARTHEST_MM = 1e6  # no scanner sees a blade a kilometre away: such a number is no coordinate

READERS: dict[str, Callable[[Path, bytes], Floats]] = {
    ".ply": lambda _, content: ply_points(content),
    ".pcd": lambda _, content: pcd_points(content),
    ".xyz": lambda _, content: text_points(content),
    ".asc": lambda _, content: text_points(content),
    ".csv": lambda _, content: text_points(content),
    ".e57": e57_points,
}


class BadScan(Refusal):
    """A measurement file that cannot be read; the text names the file and the fault."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scan:
    """The usable points of a file in its own frame, mm, and how many had no usable coordinates."""

    points_mm: Floats  # (n, 3)
    dropped: int
    sha256: str


def read_scan(path: Path) -> Scan:
    """The points of a measurement file; raises `BadScan`, also for a file without any point."""
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise BadScan(f"{path}: unknown ending, want one of {' '.join(READERS)}")
    content = read_whole(path)
    try:
        points_mm = reader(path, content)
    except Malformed as error:
        raise BadScan(f"{path}: {error}") from error
    if len(points_mm) == 0:
        raise BadScan(f"{path}: holds no points")
    usable: Bools = np.all(np.abs(points_mm) < FARTHEST_MM, axis=1)  # false for NaN and infinity, too
    return Scan(
        points_mm=points_mm[usable],
        dropped=int((~usable).sum()),
        sha256=hashlib.sha256(content).hexdigest(),
    )


def read_whole(path: Path) -> bytes:
    """The bytes of a regular file of bearable size; raises `BadScan`."""
    try:
        if not path.is_file():
            raise BadScan(f"{path}: {'is not a file' if path.exists() else 'there is no such file'}")
        if path.stat().st_size > MAX_BYTES:
            raise BadScan(f"{path}: larger than {MAX_BYTES >> 30} GiB")
        return path.read_bytes()
    except OSError as error:
        raise BadScan(f"{path}: {error.strerror or 'cannot be read'}") from error
