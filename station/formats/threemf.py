"""Closed meshes as a 3MF package: the format of a repair cell that wants units and names with its solids.

3MF Core Specification 1.3, chapters 2 (package), 3 and 4 (model, objects). Deterministic.
"""

import io
import zipfile
from collections.abc import Mapping
from xml.sax.saxutils import quoteattr

from geometry.types import Mesh

CORE = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
START_PART = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
PACKAGE = "http://schemas.openxmlformats.org/package/2006"
MODEL = "3D/3dmodel.model"
WRITTEN = (1980, 1, 1, 0, 0, 0)  # the earliest date that a zip archive knows: the same bytes every time

CONTENT_TYPES = (
    f'<Types xmlns="{PACKAGE}/content-types">'
    f'<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    f'<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/>'
    "</Types>"
)
RELATIONSHIPS = (
    f'<Relationships xmlns="{PACKAGE}/relationships">'
    f'<Relationship Id="model" Target="/{MODEL}" Type="{START_PART}"/></Relationships>'
)


def threemf(meshes: Mapping[str, Mesh]) -> bytes:
    """A 3MF package of solids by name, coordinates in mm to a nanometre."""
    parts = {"[Content_Types].xml": CONTENT_TYPES, "_rels/.rels": RELATIONSHIPS, MODEL: _model(meshes)}
    package = io.BytesIO()
    with zipfile.ZipFile(package, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in parts.items():
            entry = zipfile.ZipInfo(name, WRITTEN)
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n')
    return package.getvalue()


def _model(meshes: Mapping[str, Mesh]) -> str:
    objects = "".join(_object(number, name, mesh) for number, (name, mesh) in enumerate(meshes.items(), 1))
    items = "".join(f'<item objectid="{number}"/>' for number in range(1, len(meshes) + 1))
    return (
        f'<model unit="millimeter" xml:lang="en" xmlns="{CORE}">'
        f"<resources>{objects}</resources><build>{items}</build></model>"
    )


def _object(number: int, name: str, mesh: Mesh) -> str:
    vertices = "".join(f'<vertex x="{x:.6f}" y="{y:.6f}" z="{z:.6f}"/>' for x, y, z in mesh.vertices_mm)
    triangles = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in mesh.faces)
    return (
        f'<object id="{number}" type="model" name={quoteattr(name)}><mesh>'
        f"<vertices>{vertices}</vertices><triangles>{triangles}</triangles></mesh></object>"
    )
