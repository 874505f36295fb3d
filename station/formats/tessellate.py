"""`python -m station.formats.tessellate FILE KIND GLB`: the child of `station.formats.cad`, reads a CAD file.

It is a process of its own because the CAD kernel writes to stdout and may die on a damaged file.
"""

import sys
from pathlib import Path

import cascadio

SAG_MM = 0.002  # of a facet below the exact surface
TURN_RAD = 0.2  # between neighbouring facets


def main(path: str, kind: str, glb: str) -> int:
    """Write the triangles of a CAD file; 1 where there are none."""
    content = cascadio.load(
        Path(path).read_bytes(), file_type=kind, tol_linear=SAG_MM, tol_angular=TURN_RAD, use_parallel=False
    )
    Path(glb).write_bytes(content)
    return 0 if content else 1


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
