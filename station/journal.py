"""The job folder of one part: everything that was measured, on disk before anybody relies on it.

    DIR/jobs/000042/            named by record number, never by serial
      ticket.json               serial, sequence, recipe, part number, when
      frames/000.gdp ...        the raw wire bytes of every capture, verbatim
      frames.json               file, angle, frame index, SHA-256 and size of each, in order
      devices.json              identities and states of the devices at the start
      inputs.json               SHA-256 of plan, nominal, calibration and configuration
      inputs/                   copies of those files, so that the job replays by itself
      measurement.json  verdict.json
      result.json ...           the files of an inspection

Every file is complete under its name or absent: written beside, fsynced, renamed, folder fsynced.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Frame:
    """One raw capture in the folder; `file` is relative to it."""

    file: str
    angle_deg: float
    frame_index: int
    sha256: str
    bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class InputFile:
    """A small file that the verdict depends on: where it lies, and its path under `inputs/`."""

    role: str
    source: Path
    place: str


def job_folder(record: Path, record_no: int) -> Path:
    """Where the job of `record_no` lies."""
    return record / "jobs" / f"{record_no:06d}"


def open_job(record: Path, record_no: int, ticket: Mapping[str, Any]) -> Path:
    """The new folder of a job with its ticket; `FileExistsError` when that number was used before."""
    folder = job_folder(record, record_no)
    folder.parent.mkdir(parents=True, exist_ok=True)
    folder.mkdir()
    (folder / "frames").mkdir()
    keep_json(folder, "ticket.json", ticket)
    keep_json(folder, "frames.json", [])
    sync_folder(folder.parent)
    return folder


def keep_frame(folder: Path, frames: tuple[Frame, ...], raw: bytes, angle_deg: float, index: int) -> Frame:
    """The entry of a capture that is now on disk, after those in `frames`."""
    name = f"frames/{len(frames):03d}.gdp"
    write_durably(folder / name, raw)
    frame = Frame(
        file=name,
        angle_deg=angle_deg,
        frame_index=index,
        sha256=hashlib.sha256(raw).hexdigest(),
        bytes=len(raw),
    )
    keep_json(folder, "frames.json", [asdict(each) for each in (*frames, frame)])
    return frame


def keep_inputs(folder: Path, record: Path, inputs: Iterable[InputFile]) -> dict[str, dict[str, str]]:
    """SHA-256 and place by role of the input files, now in the folder.

    A file lies once in `DIR/inputs` under its digest and is linked into each job that used it."""
    kept = {each.role: _keep_input(folder, record / "inputs", each) for each in inputs}
    keep_json(folder, "inputs.json", kept)
    sync_folder(folder / "inputs")
    return kept


def _keep_input(folder: Path, store: Path, each: InputFile) -> dict[str, str]:
    content = each.source.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    stored = store / digest
    if not stored.exists():
        store.mkdir(exist_ok=True)
        write_durably(stored, content)
    place = folder / "inputs" / each.place
    place.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(stored, place)
    except OSError:
        shutil.copyfile(stored, place)
    return {"sha256": digest, "file": f"inputs/{each.place}"}


def keep_json(folder: Path, name: str, document: object) -> str:
    """The SHA-256 of `document`, now on disk; numbers that are not finite are refused."""
    content = json.dumps(document, allow_nan=False, indent=1).encode() + b"\n"
    write_durably(folder / name, content)
    return hashlib.sha256(content).hexdigest()


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file in the folder, by relative path, in order; empty when there is none."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.endswith(".part"))
    return {path.relative_to(folder).as_posix(): file_sha256(path) for path in files}


def file_sha256(path: Path) -> str:
    """The SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_durably(path: Path, content: bytes) -> None:
    """Returns when `path` holds `content` and would after a power cut."""
    beside = path.with_name(path.name + ".part")
    with beside.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    beside.replace(path)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Returns when the names in `folder` would survive a power cut."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
