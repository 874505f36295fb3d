"""STEP and IGES nominals through cascadio (OpenCASCADE), an extra."""

import io
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import trimesh

from geometry.blade.solid import check_solid, merge_vertices
from geometry.errors import BadInput, BadMesh
from geometry.types import Mesh

KINDS = {".step": "step", ".stp": "step", ".iges": "iges", ".igs": "iges"}
MM_PER_READ = {"step": 1000.0, "iges": 1.0}  # the kernel turns STEP into metres, IGES into mm
DEADLINE_S = 150.0


def is_cad(path: Path) -> bool:
    """Whether the ending is one of STEP or IGES."""
    return path.suffix.lower() in KINDS


def read_cad(path: Path) -> Mesh:
    """The closed, oriented solid of a STEP (ISO 10303-21) or IGES (5.3) file, as triangles in mm.

    The file states its own unit. Facets lie within 0.002 mm of the exact surface. Raises `BadMesh`, one line
    that names the file, where it has no closed solid, cannot be read, or the extra is not installed.
    """
    if find_spec("cascadio") is None:
        raise BadMesh(f"{path}: reading STEP or IGES needs the extra: pip install 'bladecell[cad]'")
    kind = KINDS[path.suffix.lower()]
    try:
        loaded = trimesh.load_mesh(io.BytesIO(_tessellated(path, kind)), file_type="glb", process=False)
        vertices = np.asarray(loaded.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.asarray(loaded.faces, dtype=np.int64).reshape(-1, 3)
        mesh = merge_vertices(MM_PER_READ[kind] * vertices, faces)
        check_solid(mesh)
    except BadInput as fault:
        raise BadMesh(f"{path}: {fault}") from None
    except (ValueError, KeyError, IndexError, AttributeError, TypeError) as fault:
        raise BadMesh(f"{path}: no triangles came of it: {' '.join(str(fault).split())[:200]}") from fault
    return mesh


def _tessellated(path: Path, kind: str) -> bytes:
    """The triangles as binary glTF; the CAD kernel's own words, which are not one line, are dropped."""
    with tempfile.TemporaryDirectory(prefix="bladecell-cad-") as folder:
        glb = Path(folder) / "solid.glb"
        command = [sys.executable, "-m", "station.formats.tessellate", str(path), kind, str(glb)]
        try:
            ended = subprocess.run(command, capture_output=True, timeout=DEADLINE_S, check=False)  # noqa: S603
        except subprocess.TimeoutExpired:
            raise BadMesh(f"was not made into triangles within {DEADLINE_S:g} s") from None
        if ended.returncode != 0 or not glb.is_file():
            raise BadMesh(f"holds no solid that can be read as {kind.upper()}")
        return glb.read_bytes()
