"""The simulated cell: one part on one turntable before one scanner, and a PLC that loads the next.

Parts come from a `Studio`: processes of their own build blades and cast rays, so that the wire never waits
for either. With `RecordedParts` they come from the job folders of an earlier run instead.
"""

import asyncio
import hashlib
import json
import multiprocessing
import signal
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drivers.wire.errors import BadReply
from drivers.wire.scanner import Stamp, decode_group, encode_cloud, encode_stamp, quantise, restamp
from simulators.scanner import SERIAL, ScannerDevice
from simulators.station_files import copy_inputs
from simulators.turntable import TurntableDevice

if TYPE_CHECKING:
    from simulators.rig import Rig

Truth = dict[str, Any]
GroupOf = Callable[[Stamp], bytes]

_ANGLE_TOLERANCE_DEG = 0.05
_STUDIO_S = 120.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LoadedPart:
    """The part that now stands on the table; `truth` is None for a recorded one."""

    index: int
    serial: str
    truth: Truth | None


class StudioFailed(Exception):
    """The process that makes the parts is gone, or could not do what it was asked."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """Which sequence of parts a studio makes."""

    preset: str
    seed: int
    nominal: Path | None = None


class Studio:
    """Synthetic parts, made and pictured in processes of their own.

    Two benches take turns: while one part is being scanned, the next is made, if `ahead` says so.
    """

    def __init__(self, order: Order, *, ahead: bool) -> None:
        self._benches = (Bench(order), Bench(order))
        self._ahead = ahead
        self._bench = self._benches[0]
        self._making: asyncio.Task[Any] | None = None

    async def load(self, index: int) -> LoadedPart:
        """Put part `index` on the table."""
        self._bench = self._benches[index % 2]
        serial, truth = await self._bench.ask("load", index)
        if self._ahead:
            self._making = asyncio.ensure_future(self._make(index + 1))
        return LoadedPart(index=index, serial=serial, truth=truth)

    async def expose(self, angle_deg: float) -> GroupOf:
        """The point cloud at a table angle, as one type 28 message behind the stamp."""
        cloud: bytes = await self._bench.ask("expose", angle_deg)
        return lambda stamp: encode_stamp(stamp) + cloud

    async def write_files(self, folder: Path) -> tuple[str, str]:
        """Write calibration and recipe into `folder`; their paths, relative to it."""
        calibration, plan = await self._bench.ask("write_files", folder)
        return calibration, plan

    async def _make(self, index: int) -> None:
        with suppress(StudioFailed):  # it shows again when the part is wanted
            await self._benches[index % 2].ask("load", index)

    def close(self) -> None:
        """End the processes."""
        if self._making is not None:
            self._making.cancel()
        for bench in self._benches:
            bench.close()


class Bench:
    """One process with one part under its light; started when first asked, again if it dies."""

    def __init__(self, order: Order) -> None:
        self._order = order
        self._lock = asyncio.Lock()
        self._process: SpawnProcess | None = None
        self._pipe: Connection | None = None
        self._index: int | None = None

    async def ask(self, verb: str, argument: object) -> Any:
        """What the process answers; raises `StudioFailed`."""
        async with self._lock:
            try:
                done, answer = await asyncio.to_thread(self._exchange, verb, argument)
            except (EOFError, OSError):
                self.close()
                done, answer = await asyncio.to_thread(self._exchange_anew, verb, argument)
        if not done:
            raise StudioFailed(answer)
        self._index = argument if verb == "load" and isinstance(argument, int) else self._index
        return answer

    def _exchange(self, verb: str, argument: object) -> tuple[bool, Any]:
        pipe = self._pipe or self._start()
        pipe.send((verb, argument))
        if not pipe.poll(_STUDIO_S):
            raise EOFError(f"no answer to {verb!r} within {_STUDIO_S:g} s")
        answer: tuple[bool, Any] = pipe.recv()
        return answer

    def _exchange_anew(self, verb: str, argument: object) -> tuple[bool, Any]:
        try:
            if self._index is not None:
                self._exchange("load", self._index)
            return self._exchange(verb, argument)
        except (EOFError, OSError) as error:
            return False, f"the process that makes the parts died twice: {error!r}"

    def _start(self) -> Connection:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_work, args=(theirs, self._order), daemon=True)
        self._process.start()
        # Only the child holds its end now: each side sees the other die.
        theirs.close()
        return self._pipe

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process = None
        if self._pipe is not None:
            self._pipe.close()
            self._pipe = None


def _work(pipe: Connection, order: Order) -> None:
    """A bench's process: orders in, (True, answer) or (False, why not) out, until the parent is gone."""
    for interruption in (signal.SIGINT, signal.SIGTERM):
        signal.signal(interruption, signal.SIG_IGN)
    part = _Part(order)
    while True:
        try:
            verb, argument = pipe.recv()
        except EOFError:
            return
        try:
            answer = (True, getattr(part, verb)(argument))
        except Exception as error:
            answer = (False, f"{type(error).__name__}: {error}")
        pipe.send(answer)


class _Part:
    """The part under the simulated light; lives in a bench's process."""

    def __init__(self, order: Order) -> None:
        self._order = order
        self._index: int | None = None

    @cached_property
    def _rig(self) -> "Rig":
        # Here, so that only this process pays for the ray caster.
        from simulators.presets import rig_for

        return rig_for(self._order.seed, self._order.nominal)

    def load(self, index: int) -> tuple[str, Truth]:
        """Serial and truth of part `index`, which now stands under the light; made if it does not yet."""
        from simulators.presets import part_for

        if index != self._index:
            part = part_for(self._order.preset, self._order.seed, index, self._order.nominal)
            self._light = part.before(self._rig)
            self._rng = np.random.default_rng([self._order.seed, index, 28])
            self._index, self._label = index, (part.serial, dict(part.truth))
        return self._label

    def expose(self, angle_deg: float) -> bytes:
        """The last message of a group: the seen points as a type 28 surface."""
        counts, scale_nm, offset_um = quantise(self._light.capture(angle_deg, self._rng))
        return encode_cloud(counts, scale_nm, offset_um)

    def write_files(self, folder: Path) -> tuple[str, str]:
        """Paths of calibration and plan, which now lie in `folder`."""
        from simulators.calibration_file import write_calibration
        from simulators.presets import write_recipe

        folder.mkdir(parents=True, exist_ok=True)
        calibration, plan = "calibration.toml", "blades/sim/plan.toml"
        write_calibration(folder / calibration, self._rig, self._order.seed)
        write_recipe((folder / plan).parent, self._order.preset, self._order.seed, self._order.nominal)
        return calibration, plan


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedFrame:
    """One raw group of a job folder and the table angle at which it was taken."""

    file: Path
    angle_deg: float
    sha256: str


class BadJob(Exception):
    """A job folder that cannot be replayed; one line that names the file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedJob:
    """A job folder, as far as a replay on the wire needs it."""

    folder: Path
    serial: str
    scanner_serial: int
    frames: tuple[RecordedFrame, ...]

    def nearest(self, angle_deg: float) -> RecordedFrame | None:
        """The frame recorded at this angle of the table, whatever the turn; None if there is none."""
        best = min(self.frames, key=lambda frame: _apart_deg(frame.angle_deg, angle_deg))
        return best if _apart_deg(best.angle_deg, angle_deg) <= _ANGLE_TOLERANCE_DEG else None


def read_job(folder: Path) -> RecordedJob:
    """The recorded job in a folder; raises `BadJob`."""
    try:
        serial = json.loads((folder / "ticket.json").read_text())["serial"]
        rows = json.loads((folder / "frames.json").read_text())
        frames = tuple(
            RecordedFrame(file=folder / row["file"], angle_deg=float(row["angle_deg"]), sha256=row["sha256"])
            for row in rows
        )
        scanner_serial = decode_group(_read_frame(frames[0])).scanner_serial
    except (OSError, ValueError, KeyError, TypeError, IndexError, BadReply) as error:
        raise BadJob(f"{folder}: is not a job with frames: {type(error).__name__}: {error}") from error
    return RecordedJob(folder=folder, serial=str(serial), scanner_serial=scanner_serial, frames=frames)


class RecordedParts:
    """The parts of recorded jobs in their order, over and over; their frames come back bit by bit."""

    def __init__(self, jobs: tuple[RecordedJob, ...]) -> None:
        self.jobs = jobs
        self._job = jobs[0]

    async def load(self, index: int) -> LoadedPart:
        """Put the part of job `index` on the table."""
        self._job = self.jobs[index % len(self.jobs)]
        return LoadedPart(index=index, serial=self._job.serial, truth=None)

    async def expose(self, angle_deg: float) -> GroupOf:
        """The frame recorded at this angle, with the live stamp; nothing seen where none was recorded."""
        frame = self._job.nearest(angle_deg)
        if frame is None:
            blind, scale_nm, offset_um = quantise(np.full((1, 1, 3), np.nan))
            return lambda stamp: encode_stamp(stamp) + encode_cloud(blind, scale_nm, offset_um)
        raw = await asyncio.to_thread(_read_frame, frame)
        return lambda stamp: restamp(raw, stamp)

    async def write_files(self, folder: Path) -> tuple[str, str]:
        """Copy calibration and recipe of the first job into `folder`; their paths, relative to it."""
        try:
            return copy_inputs(self.jobs[0].folder, folder)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise BadJob(f"{self.jobs[0].folder}: inputs.json: {type(error).__name__}: {error}") from error

    def close(self) -> None:
        """Nothing to end."""


def _read_frame(frame: RecordedFrame) -> bytes:
    raw = frame.file.read_bytes()
    if hashlib.sha256(raw).hexdigest() != frame.sha256:
        raise BadJob(f"{frame.file}: is not what frames.json says was recorded")
    return raw


def _apart_deg(a_deg: float, b_deg: float) -> float:
    return abs((a_deg - b_deg + 180.0) % 360.0 - 180.0)


@dataclass(slots=True, kw_only=True)
class SimCell:
    """The devices of one cell around the part that stands on its table."""

    parts: Studio | RecordedParts
    clock: Callable[[], float]
    on_load: Callable[[LoadedPart], None]
    turntable: TurntableDevice = field(default_factory=TurntableDevice)
    scanner: ScannerDevice = field(default_factory=lambda: ScannerDevice(serial=SERIAL))
    part: LoadedPart | None = None

    async def load(self, index: int) -> str:
        """The serial of part `index`, which now stands on the table; the one that stands there stays."""
        if self.part is None or self.part.index != index:
            self.part = await self.parts.load(index)
            self.on_load(self.part)
        return self.part.serial

    async def expose(self) -> GroupOf:
        """The picture of the part at the angle at which the table truly stands now."""
        return await self.parts.expose(self.turntable.angle_deg(self.clock()))
