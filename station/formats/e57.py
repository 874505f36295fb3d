"""E57 (ASTM E2807) through pye57, an extra.

The standard means metres; here the numbers are mm, as in every scan of ours. A file in metres is too small
to be aligned and ends as HOLD, never as a blade of another size."""

import struct
from pathlib import Path

import numpy as np

from geometry.types import Floats
from station.formats.malformed import Malformed

HEADER = struct.Struct("<8sIIQ")  # signature, version, version, length of the file


def e57_points(path: Path, content: bytes) -> Floats:
    """The points (n, 3) of all scans of a file, mm; raises `Malformed`."""
    if len(content) < HEADER.size or content[:8] != b"ASTM-E57":
        raise Malformed("not an E57 file")
    declared = HEADER.unpack_from(content)[3]
    if declared != len(content):
        raise Malformed(f"the header declares {declared} bytes, the file has {len(content)}")
    try:
        import pye57
    except ImportError:
        raise Malformed("reading E57 needs the extra: pip install 'bladecell[e57]'") from None
    try:
        file = pye57.E57(str(path))
        scans = [file.read_scan(i, ignore_missing_fields=True) for i in range(file.scan_count)]
        axes = ("cartesianX", "cartesianY", "cartesianZ")
        clouds = [np.stack([scan[axis] for axis in axes], axis=1) for scan in scans]
    except Exception as error:
        raise Malformed(f"E57: {str(error).splitlines()[0] if str(error) else 'unreadable'}") from error
    return np.concatenate([np.empty((0, 3)), *clouds])
