"""STEP and IGES nominals through cascadio (OpenCASCADE), an extra."""

import io
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path

from geometry.blade.read import read_solid
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
        return read_solid(io.BytesIO(_tessellated(path, kind)), MM_PER_READ[kind], "glb")
    except BadInput as fault:
        raise BadMesh(f"{path}: {fault}") from None


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
