"""The open cell: devices, worker, record, registers and screens, and where the station stands.

`open_cell` owns them all and gives them back in the right order. What is done with them stands in
cycle.py; here are only the means: connect, stop, tell, keep.
"""

import asyncio
import hashlib
from collections.abc import AsyncIterator, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Literal, ParamSpec, TypeVar

import numpy as np

from drivers.errors import DriverError
from drivers.plc import PlcLink
from drivers.scanner import Scanner
from drivers.turntable import Turntable
from station import alarms as engine
from station import phases
from station.acquire import ScanPlan
from station.alarms import Alarms
from station.chain import RecordFailed
from station.config import Calibration, StationConfig, read_calibration
from station.events import (
    AlarmCleared,
    AlarmRaised,
    DeviceState,
    DeviceStatus,
    Event,
    Intent,
    LogLine,
    StationStatus,
)
from station.handshake import Handshake, Health, Interrupt
from station.journal import InputFile
from station.phases import State, Trigger
from station.plans import BladePlan, read_plan
from station.record import Record
from station.stream import EventStream
from station.worker import Desk, GeometryWorker

P = ParamSpec("P")
T = TypeVar("T")

CONNECT_S = 20.0
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.2, 2.0
STOP_S = 2.0
DISK_S = 15.0  # for one step of a part: a request that is broken off meanwhile is over within 20 s
REOPEN_S = 120.0
WARM_S = 600.0
MAX_INTENTS = 64


@dataclass(frozen=True, slots=True, kw_only=True)
class RecipeFile:
    """One entry of [recipes], read at the start. `digests`: SHA-256 of its input files by role."""

    number: int
    plan: BladePlan
    inputs: tuple[InputFile, ...]
    digests: Mapping[str, str]


@dataclass(slots=True, kw_only=True)
class Cell:
    """Everything that the procedure of cycle.py works with."""

    config: StationConfig
    calibration: Calibration
    recipes: Mapping[int, RecipeFile]
    record: Record
    disk: ThreadPoolExecutor
    plc: PlcLink
    stream: EventStream
    worker: GeometryWorker
    version: str
    clock: Callable[[], float]
    intents: asyncio.Queue[Intent]
    headless: bool
    wanted: bool  # started by an operator, or headless
    state: State = State.BOOT
    shake: Handshake = field(default_factory=Handshake)
    alarms: Alarms = field(default_factory=Alarms)
    turntable: Turntable | None = None
    scanner: Scanner | None = None
    links: dict[str, AsyncExitStack] = field(default_factory=dict)
    interrupt: Interrupt | None = None
    part: asyncio.Task[None] | None = None
    serving: asyncio.Task[None] | None = None
    failure: Exception | None = None  # of a task beside the procedure
    leaving: bool = False
    shown: object = None  # the handshake as the screens saw it last
    plc_seen: bool = False  # its heartbeat was alive at the last look
    moved: asyncio.Event = field(default_factory=asyncio.Event)
    jog_deg: float | None = None
    reset_by: Literal["plc", "operator"] | None = None

    async def on_disk(self, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """The result of `call` on the one disk thread: in order, and never in the loop.

        Raises `RecordFailed` when the disk is not done after DISK_S. What it writes may still come to its
        end, so the record takes nothing more until it is opened again."""
        return await self._within(DISK_S, partial(call, *args, **kwargs))

    async def reopen_record(self) -> None:
        """Opens the record again after it failed; a long one is read for as long as REOPEN_S."""
        await self._within(REOPEN_S, self.record.reopen)

    async def _within(self, timeout_s: float, call: Callable[[], T]) -> T:
        done = asyncio.get_running_loop().run_in_executor(self.disk, call)
        try:
            async with asyncio.timeout(timeout_s) as limit:
                return await done
        except TimeoutError as error:
            if not limit.expired():
                raise
            self.record.distrust()
            late = f"the disk is not done after {timeout_s:g} s"
            raise RecordFailed(f"{self.record.directory}: {late}") from error

    async def until(self, holds: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Whether `holds` came true; it is looked at whenever something has changed."""
        with suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                while not holds():
                    self.moved.clear()
                    await self.moved.wait()
        return holds()

    def fire(self, trigger: Trigger, detail: str = "") -> None:
        """Moves the station by the table; a trigger that the table refuses is logged and changes nothing."""
        state = phases.after(self.state, trigger)
        if state is None:
            self.log("debug", f"{trigger} means nothing in {self.state}")
            return
        self.state = state
        self.plc.set_state(phases.PACKML[state])
        self.tell_state(detail)
        self.moved.set()

    def tell_state(self, detail: str = "") -> None:
        """Shows the state to the screens."""
        self.stream.emit(
            StationStatus(
                state=self.state,
                mode=self.config.mode,
                packml=phases.PACKML[self.state],
                station_id=self.config.station_id,
                version=self.version,
                detail=detail,
            )
        )

    def emit(self, event: Event) -> None:
        """Tells the screens."""
        self.stream.emit(event)

    def log(self, level: Literal["debug", "info", "warning", "error"], text: str) -> None:
        """One line for the screens and the log file."""
        self.stream.emit(LogLine(level=level, text=text, at_utc=utc_now()))

    def alarm(self, number: int, detail: str = "", *, lasting: bool = True) -> None:
        """Raises an alarm."""
        self.settle(engine.raised(self.alarms, number, detail, utc_now(), lasting=lasting))

    def settle(self, alarms: Alarms) -> None:
        """Takes over the alarms as they are now and tells the screens what changed."""
        changed, gone = engine.changes(self.alarms, alarms)
        self.alarms = alarms
        for alarm in changed:
            self.emit(
                AlarmRaised(
                    number=alarm.kind.number,
                    priority=alarm.kind.priority,
                    text=alarm.text,
                    action=alarm.kind.action,
                    state=alarm.state,
                    first_out=alarm.first_out,
                    at_utc=alarm.at_utc,
                )
            )
        for number in gone:
            self.emit(AlarmCleared(number=number))

    def device(self, name: str, state: DeviceState, detail: str = "") -> None:
        """Shows the state of a device."""
        self.emit(DeviceStatus(device=name, state=state, detail=detail))

    @property
    def working(self) -> bool:
        """Whether the mode lets verdicts out."""
        return self.config.mode in ("PRODUCTION", "SIMULATION")

    @property
    def ready(self) -> bool:
        """Whether a part would be accepted now."""
        return self.state is State.IDLE and self.working and not self.alarms.blocking

    @property
    def reset_asked(self) -> bool:
        """Whether somebody wants the fault to be cleared."""
        return self.reset_by is not None

    def health(self, now_s: float) -> Health:
        """What the status word says beside the handshake."""
        standing = self.state in (State.IDLE, State.SUSPENDED, State.COMPLETING, State.COMPLETE)
        return Health(
            ready=self.ready,
            faulted=self.state in phases.FAULTED,
            moving=self.state in (State.RESETTING, State.CLEARING, State.STOPPING, State.ABORTING),
            plc_alive=self.plc.plc_alive(now_s),
            manual=self.config.mode == "MAINTENANCE",
            safe_to_unload=standing and self.turntable is not None,
            calibration_due=self.calibration_left_days() < 0.1 * self.config.calibration.max_age_days,
        )

    def calibration_left_days(self) -> float:
        """Days until the calibration expires; negative when it has, or when it lies in the future."""
        age_days = self.calibration.age_days(datetime.now(UTC))
        return self.config.calibration.max_age_days - age_days if age_days >= 0.0 else -1.0

    def scan_plan(self, recipe: RecipeFile) -> ScanPlan:
        """How a part of this recipe is scanned."""
        return ScanPlan(
            angles_deg=tuple(recipe.plan.scan.angles_deg),
            tolerance_deg=self.config.turntable.position_tolerance_deg,
            T_scanner_table0=np.array(self.calibration.T_scanner_table0),
        )

    def fail(self, error: Exception) -> None:
        """Ends the procedure because of something that went wrong beside it."""
        self.failure = error
        if self.serving is not None:
            self.serving.cancel()

    def leave(self) -> None:
        """Ends the station: a part on the table gets HOLD."""
        self.leaving = True
        self.moved.set()
        if self.serving is not None:
            self.serving.cancel()

    async def connect(self) -> None:
        """Opens both devices, trying again with back-off; raises the last `DriverError` after CONNECT_S."""
        await self.disconnect()
        deadline_s, pause_s = self.clock() + CONNECT_S, FIRST_PAUSE_S
        while True:
            try:
                await self._open_devices()
            except DriverError as error:
                await self.disconnect()
                self.device(error.device, "OFFLINE", str(error))
                if self.clock() + pause_s > deadline_s:
                    raise
                await asyncio.sleep(pause_s)
                pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)
            else:
                return

    async def _open_devices(self) -> None:
        await self.connect_turntable()
        await self.connect_scanner()

    async def connect_turntable(self) -> None:
        """Opens the turntable; raises `DriverError`."""
        await self._unlink("turntable")
        self.device("turntable", "CONNECTING", self.config.turntable.port)
        turntable = Turntable(**self.config.turntable.model_dump())
        await self.links["turntable"].enter_async_context(turntable)
        self.turntable = turntable
        self.device("turntable", "READY", f"device {turntable.identity.device_id}")

    async def connect_scanner(self) -> None:
        """Opens the scanner and sees that it runs; raises `DriverError`."""
        await self._unlink("scanner")
        self.device("scanner", "CONNECTING", self.config.scanner.host)
        scanner = Scanner(**self.config.scanner.model_dump())
        await self.links["scanner"].enter_async_context(scanner)
        await scanner.prepare()
        self.scanner = scanner
        self.device("scanner", "READY", f"serial {self.config.scanner.serial}")

    async def disconnect(self) -> None:
        """Closes both devices."""
        self.turntable = self.scanner = None
        for device in ("turntable", "scanner"):
            await self._unlink(device)

    async def _unlink(self, device: str) -> None:
        link = self.links.pop(device, AsyncExitStack())
        self.links[device] = AsyncExitStack()
        with suppress(DriverError, OSError, TimeoutError):
            async with asyncio.timeout(STOP_S):
                await link.aclose()

    async def stop_motion(self) -> None:
        """Returns when the table stands, or after STOP_S when it does not answer."""
        if self.turntable is None:
            return
        try:
            async with asyncio.timeout(STOP_S):
                await self.turntable.stop()
        except (DriverError, TimeoutError) as error:
            self.log("warning", f"the turntable does not confirm that it stands: {error}")


def geometry_desk(plans: Mapping[int, Path], calibration: Path) -> Desk:
    """The desk of the worker. Only that process imports the geometry."""
    from station.desk import make_desk

    return make_desk(plans, calibration)


@asynccontextmanager
async def open_cell(
    config: StationConfig,
    *,
    headless: bool,
    version: str,
    clock: Callable[[], float],
    on_event: Callable[[Event], None],
    make_desk: Callable[[Mapping[int, Path], Path], Desk] = geometry_desk,
) -> AsyncIterator[Cell]:
    """The cell of a configuration, the record locked first: a second station changes nothing.

    Raises `RecordFailed`, `BadConfig`, `BadPlan` or `LinkDown` when it cannot be opened."""
    calibration = read_calibration(config.calibration_path)
    recipes = {int(number): read_recipe(config, int(number)) for number in config.recipes}
    async with AsyncExitStack() as stack:
        identity = {"station_id": config.station_id, "version": version, "mode": config.mode}
        record = Record.open(config.record_directory, station=identity, at_utc=utc_now())
        stack.callback(record.close)
        disk = ThreadPoolExecutor(1, "disk")
        stack.callback(disk.shutdown)  # first, and waited for: what is being written is written
        plc = await stack.enter_async_context(
            PlcLink.open(
                config.plc.listen_host,
                config.plc.port,
                epoch=record.epoch,
                heartbeat_timeout_s=config.plc.heartbeat_timeout_s,
            )
        )
        intents: asyncio.Queue[Intent] = asyncio.Queue(MAX_INTENTS)
        stream = await stack.enter_async_context(
            EventStream(config.events.host, config.events.port, partial(_queue, intents), on_event)
        )
        plans = {number: recipe.plan.path for number, recipe in recipes.items()}
        worker = GeometryWorker(partial(make_desk, plans, config.calibration_path))
        stack.callback(worker.close)
        cell = Cell(
            config=config,
            calibration=calibration,
            recipes=recipes,
            record=record,
            disk=disk,
            plc=plc,
            stream=stream,
            worker=worker,
            version=version,
            clock=clock,
            intents=intents,
            headless=headless,
            wanted=headless,
        )
        yield cell
        await cell.disconnect()


def _queue(intents: asyncio.Queue[Intent], intent: Intent) -> None:
    """Takes an intent; a screen that floods is not heard."""
    if not intents.full():
        intents.put_nowait(intent)


def read_recipe(config: StationConfig, number: int) -> RecipeFile:
    """A recipe with the digests of all that it depends on."""
    path = config.plan_path(number)
    assert path is not None
    plan = read_plan(path)
    inputs = (
        InputFile(role="configuration", source=config.path, place="station.toml"),
        InputFile(role="calibration", source=config.calibration_path, place="calibration.toml"),
        InputFile(role="plan", source=plan.path, place="plan.toml"),
        InputFile(role="nominal", source=plan.nominal_path, place=plan.nominal),
    )
    digests = {each.role: hashlib.sha256(each.source.read_bytes()).hexdigest() for each in inputs}
    return RecipeFile(number=number, plan=plan, inputs=inputs, digests=digests)


def utc_now() -> str:
    """The present time as it is recorded."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")
