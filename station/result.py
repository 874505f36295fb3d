"""The files of one inspection.

Every file is complete under its name or absent. Earlier files of ours are replaced or removed only when the
new ones are ready, `result.json` last; what is not ours is never touched.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from contextlib import suppress
from errno import EISDIR
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geometry.repair.patches import in_frame
from geometry.transforms import inverse
from geometry.types import Mesh
from station.document import Inputs, Json, document, document_text, patches_of
from station.formats.threemf import threemf
from station.formats.write import ply_cloud, ply_mesh, stl
from station.report import render
from station.tables import sections_csv

if TYPE_CHECKING:
    from geometry.repair.patches import Patch
    from station.measurement import Measurement
    from station.plans import BladePlan
    from station.verdict import Verdict

OURS = re.compile(
    r"(result\.json|report\.html|deviation\.ply|twin\.ply|sections\.csv"
    r"|repair(-([1-9][0-9]*|scan|fixture))?\.stl|repair\.3mf)"
)


def write_inspection(
    folder: Path, measurement: Measurement, verdict: Verdict, plan: BladePlan, inputs: Inputs
) -> Json:
    """The result document, once it and all files that belong to it are in `folder`."""
    result = document(measurement, verdict, plan, inputs)
    files = {
        **surfaces(measurement),
        **repair_files(patches_of(measurement, verdict)),
        **framed_files(measurement, verdict, plan),
        "sections.csv": sections_csv(measurement, verdict).encode(),
        "report.html": render(result, measurement, verdict, plan).encode(),
        "result.json": document_text(result).encode(),
    }
    replace_files(folder, files)
    return result


def surfaces(measurement: Measurement) -> dict[str, bytes]:
    """The aligned scan with its deviations, and the twin, as far as there are such."""
    files = {}
    if len(measurement.aligned_mm):
        files["deviation.ply"] = ply_cloud(measurement.aligned_mm, measurement.deviation_mm)
    if measurement.twin_mesh is not None:
        files["twin.ply"] = ply_mesh(measurement.twin_mesh)
    return files


def repair_files(patches: list[Patch]) -> dict[str, bytes]:
    """Each patch as a file, and all of them as one of each format."""
    meshes: list[Mesh] = [patch.written for patch in patches]
    files = {f"repair-{number}.stl": stl([mesh]) for number, mesh in enumerate(meshes, 1)}
    if not meshes:
        return files
    named = {
        f"repair-{n} {patch.zone}": mesh
        for n, (patch, mesh) in enumerate(zip(patches, meshes, strict=True), 1)
    }
    return files | {"repair.stl": stl(meshes), "repair.3mf": threemf(named)}


def framed_files(measurement: Measurement, verdict: Verdict, plan: BladePlan) -> dict[str, bytes]:
    """All patches in each further frame that the plan wants."""
    patches = patches_of(measurement, verdict)
    if not patches or measurement.alignment is None:
        return {}
    T_scan_nominal = inverse(measurement.alignment.T_nominal_scan)
    T_fixture_scan = np.eye(4) if plan.repair.T_fixture_scan is None else np.array(plan.repair.T_fixture_scan)
    frames = {"scan": T_scan_nominal, "fixture": T_fixture_scan @ T_scan_nominal}
    return {
        f"repair-{frame}.stl": stl([in_frame(patch.written, frames[frame]) for patch in patches])
        for frame in plan.repair.frames
    }


def replace_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Puts `files` into `folder`, the last of them last, and removes what else of ours lies there.

    All are on disk under temporary names before the first takes its name; `OSError` leaves none of these.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        put(folder, files)
    except OSError:
        for name in files:
            with suppress(OSError):
                (folder / f".{name}.part").unlink(missing_ok=True)
        raise
    sync(folder)


def put(folder: Path, files: Mapping[str, bytes]) -> None:
    """Writes all beside their names, then renames them."""
    for name, content in files.items():
        if (folder / name).is_dir():
            raise IsADirectoryError(EISDIR, os.strerror(EISDIR), str(folder / name))
        write_beside(folder / f".{name}.part", content)
    *others, last = files
    for name in others:
        (folder / f".{name}.part").replace(folder / name)
    for path in folder.iterdir():
        if OURS.fullmatch(path.name) and path.name not in files and not path.is_dir():
            path.unlink()
    (folder / f".{last}.part").replace(folder / last)


def write_beside(path: Path, content: bytes) -> None:
    """Writes a file that nobody else has, and waits until it is on disk."""
    path.unlink(missing_ok=True)
    with path.open("xb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def sync(folder: Path) -> None:
    """Waits until the names in `folder` are on disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
