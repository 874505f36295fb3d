"""The nominal's file -> a solid mesh in millimetres."""

from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
import trimesh

from geometry.blade.solid import check_solid, merge_vertices
from geometry.errors import BadInput, BadMesh
from geometry.types import Floats, Ints, Mesh

MM_PER_UNIT = {"mm": 1.0, "inch": 25.4}
ENDINGS = (".stl", ".ply", ".obj", ".3mf")


def read_nominal(path: Path, units: Literal["mm", "inch"]) -> Mesh:
    """The closed, oriented solid in an STL, PLY, OBJ or 3MF file, in mm, its equal vertices made one.

    Raises `BadMesh`, one line that names the file and the fault, for anything else.
    """
    try:
        if path.suffix.lower() not in ENDINGS:
            raise BadMesh(f"ending {path.suffix!r} is none of {', '.join(ENDINGS)}")
        if not path.is_file():
            raise BadMesh("no such file")
        return read_solid(path, MM_PER_UNIT[units])
    except BadInput as fault:
        raise BadMesh(f"{path}: {fault}") from None


def read_solid(source: Path | BinaryIO, mm_per_unit: float, kind: str | None = None) -> Mesh:
    """The closed, oriented solid of a mesh file, in mm; `kind` is the ending of one that is open already.

    Raises `BadMesh`, one line that names the fault.
    """
    vertices, faces = _load_triangles(source, kind)
    mesh = merge_vertices(vertices * mm_per_unit, faces)
    check_solid(mesh)
    return mesh


def _load_triangles(source: Path | BinaryIO, kind: str | None) -> tuple[Floats, Ints]:
    try:
        loaded = trimesh.load_mesh(source, file_type=kind, process=False)
        vertices = np.asarray(loaded.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.asarray(loaded.faces, dtype=np.int64).reshape(-1, 3)
    except Exception as fault:  # the readers raise whatever a damaged file makes them stumble over
        raise BadMesh(
            f"cannot be read: {' '.join(str(fault).split())[:200] or type(fault).__name__}"
        ) from fault
    if not np.isfinite(vertices).all():
        raise BadMesh("has vertices that are not finite")
    return vertices, faces
