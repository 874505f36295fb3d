"""A whole station in one event loop: real drivers, simulated devices on loopback, a PLC written here.

The devices are the simulators' own with a small cloud for a picture; the PLC is pyModbusTCP, which shares
no code with the station.
"""

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import recipe_desk
from pyModbusTCP.client import ModbusClient

from drivers.wire.plc import Ctrl, PlcRequest, StatusBits, encode_request
from drivers.wire.scanner import Stamp, encode_cloud, encode_stamp, quantise
from simulators.faults import Faults
from simulators.scanner import ScannerDevice, ScannerPorts, serve_scanner
from simulators.serve import serve_tcp
from simulators.turntable import TurntableDevice, TurntableSession
from station.cell import Cell, open_cell
from station.config import read_config
from station.events import Event
from station.operate import run_forever

HOST = "127.0.0.1"
UP = Ctrl.ENABLE | Ctrl.PART_PRESENT
ANGLES_DEG = (0, 90, 180)
WAIT_S = 40.0

PLAN = """
schema = "bladecell.plan/1"
part_number = "HPC-R3"
revision = "B"
nominal = "nominal.stl"
[measurement]
sigma_mm = 0.015
[sections]
z_mm = [7.0]
[limits.section]
chord_mm = { serviceable = 0.25, repairable = 1.0 }
[limits.form]
deviation_mm = { serviceable = 0.15, repairable = 0.5 }
[limits.damage.tip]
depth_mm = { serviceable = 0.5, repairable = 15.0 }
volume_mm3 = { serviceable = 5.0, repairable = 400.0 }
count = { serviceable = 1, repairable = 2 }
[limits.damage.leading_edge]
depth_mm = { serviceable = 0.5, repairable = 3.0 }
[limits.damage.trailing_edge]
depth_mm = { serviceable = 0.5, repairable = 3.0 }
[limits.damage.surface]
depth_mm = { serviceable = 0.5, repairable = 3.0 }
[scan]
angles_deg = %s
"""

STATION = """
schema = "bladecell.station/1"
station_id = "TEST"
mode = "%(mode)s"
[turntable]
port = "socket://127.0.0.1:%(turntable)d"
[scanner]
host = "127.0.0.1"
modbus_port = %(modbus)d
control_port = %(control)d
data_port = %(data)d
serial = %(serial)d
capture_timeout_s = 1.5
[plc]
listen_host = "127.0.0.1"
port = %(plc)d
[record]
directory = "record"
[events]
port = %(events)d
[calibration]
file = "calibration.toml"
max_age_days = 36500
[worker]
timeout_s = 3.0
[recipes]
%(recipes)s
"""

CALIBRATION = """
schema = "bladecell.calibration/1"
created_utc = 2026-01-01T00:00:00Z
T_scanner_table0 = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
sigma_axis_offset_mm = 0.003
sigma_axis_tilt_deg = 0.002
scanner_serial = %d
"""


@dataclass
class Plc:
    """A PLC in a few lines: its registers, and a heartbeat of its own."""

    port: int
    request: PlcRequest = field(default_factory=lambda: PlcRequest(ctrl=UP, epoch=9, recipe=1))
    beating: bool = True

    async def write(self, **changed: object) -> None:
        """Writes 0-28 in one go."""
        self.request = replace(self.request, **changed)  # type: ignore[arg-type]
        await self._send()

    async def _send(self) -> None:
        """Writes 0-28; waits for a station that is not there yet."""
        registers = encode_request(self.request)
        deadline_s = time.monotonic() + WAIT_S
        while not await self._call(self._client.write_multiple_registers, 0, registers):
            assert time.monotonic() < deadline_s, "no station"
            await asyncio.sleep(0.1)

    async def _call(self, call: Callable[..., Any], *arguments: Any) -> Any:
        async with self._lock:  # the client is not for two threads at once
            return await asyncio.to_thread(call, *arguments)

    async def read(self) -> list[int]:
        """Registers 100-139 in one go."""
        registers = await self._call(self._client.read_holding_registers, 100, 40)
        return [int(each) for each in registers or [0] * 40]

    async def status(self) -> StatusBits:
        return StatusBits((await self.read())[0])

    async def until(self, holds: Callable[[list[int]], bool], timeout_s: float = WAIT_S) -> list[int]:
        """The registers once they are as awaited."""
        deadline_s = time.monotonic() + timeout_s
        while not holds(block := await self.read()):
            assert time.monotonic() < deadline_s, f"waited in vain: {block}"
            await asyncio.sleep(0.02)
        return block

    async def until_bits(self, up: StatusBits, down: StatusBits = StatusBits(0)) -> list[int]:
        return await self.until(lambda block: block[0] & up == up and not block[0] & down)

    async def ask(self, sequence: int, serial: str = "SN-1", recipe: int = 1) -> None:
        """Raises START with a request."""
        await self.write(sequence=sequence, serial=serial, recipe=recipe, ctrl=UP | Ctrl.START)

    async def answer(self, sequence: int, code: int = 1) -> None:
        """Acknowledges, and lets go once RESULT_VALID fell."""
        await self.write(ctrl=UP | Ctrl.RESULT_ACK, ack_sequence=sequence, ack_code=code)
        await self.until_bits(StatusBits(0), StatusBits.RESULT_VALID)
        await self.write(ctrl=UP)

    async def run(self) -> None:
        """Beats."""
        while True:
            if self.beating:
                self.request = replace(self.request, heartbeat=(self.request.heartbeat + 1) & 0xFFFF)
                await self._call(self._client.write_single_register, 1, self.request.heartbeat)
            await asyncio.sleep(0.2)

    @classmethod
    @asynccontextmanager
    async def talking(cls, port: int) -> AsyncIterator["Plc"]:
        """A PLC that beats, also while nobody listens."""
        plc = cls(port)
        beating = asyncio.create_task(plc.run())
        try:
            yield plc
        finally:
            beating.cancel()
            plc.close()

    def __post_init__(self) -> None:
        self._client = ModbusClient(HOST, self.port, unit_id=1, timeout=5.0, auto_open=True)
        self._lock = asyncio.Lock()

    def close(self) -> None:
        self._client.close()


@dataclass
class Rig:
    """What a test holds in its hands."""

    folder: Path
    cell: Cell
    plc: Plc
    turntable: TurntableDevice
    scanner: ScannerDevice
    events: list[Event]
    running: "asyncio.Task[None]"
    sequence: int = 0

    def of(self, kind: type) -> list[Event]:
        """The events of a kind, in order."""
        return [event for event in self.events if isinstance(event, kind)]


async def picture(_: ScannerDevice | None = None) -> Callable[[Stamp], bytes]:
    """A few points that never repeat."""
    points_mm = np.random.default_rng().normal(0.0, 20.0, (10, 10, 3))
    cloud = encode_cloud(*quantise(points_mm))
    return lambda stamp: encode_stamp(stamp) + cloud


def write_files(folder: Path, ports: dict[str, int], *, mode: str, scanner_serial: int) -> Path:
    """The configuration of the rig with plan, nominal and calibration beside it."""
    (folder / "plan.toml").write_text(PLAN % list(ANGLES_DEG))
    (folder / "nominal.stl").write_bytes(b"only its digest matters here")
    (folder / "calibration.toml").write_text(CALIBRATION % scanner_serial)
    recipes = "\n".join(f'{number} = "plan.toml"' for number in range(1, 8))
    text = STATION % {**ports, "mode": mode, "serial": scanner_serial, "recipes": recipes}
    (folder / "station.toml").write_text(text)
    return folder / "station.toml"


@asynccontextmanager
async def devices(
    turntable_faults: Faults | None = None,
) -> AsyncIterator[tuple[TurntableDevice, ScannerDevice, dict[str, int]]]:
    """Turntable and scanner on the wire, and their ports."""
    turntable, scanner, clock = TurntableDevice(), ScannerDevice(), time.monotonic
    async with AsyncExitStack() as stack:
        table = await stack.enter_async_context(
            serve_tcp(HOST, 0, lambda: TurntableSession(turntable, clock), turntable_faults)
        )
        ports = await stack.enter_async_context(
            serve_scanner(
                scanner, picture, host=HOST, ports=ScannerPorts(modbus=0, control=0, data=0), clock=clock
            )
        )
        yield (
            turntable,
            scanner,
            {
                "turntable": table.port,
                "modbus": ports.modbus,
                "control": ports.control,
                "data": ports.data,
            },
        )


@asynccontextmanager
async def station(
    folder: Path, *, mode: str = "SIMULATION", plc_port: int = 0, write: bool = True
) -> AsyncIterator[Rig]:
    """A running station with its devices, its PLC and its event stream."""
    events: list[Event] = []
    async with AsyncExitStack() as stack:
        turntable, scanner, ports = await stack.enter_async_context(devices())
        if write:
            free = {"plc": plc_port or free_port(), "events": free_port()}
            write_files(folder, ports | free, mode=mode, scanner_serial=scanner.serial)
        cell = await stack.enter_async_context(
            open_cell(
                read_config(folder / "station.toml"),
                headless=True,
                version="test",
                clock=time.monotonic,
                on_event=events.append,
                make_desk=recipe_desk.make,
            )
        )
        running = asyncio.create_task(run_forever(cell))
        plc = await stack.enter_async_context(Plc.talking(cell.plc.port))
        await plc.write()
        try:
            yield Rig(folder, cell, plc, turntable, scanner, events, running)
        finally:
            cell.leave()
            await asyncio.wait_for(_quietly(running), 20.0)


async def _quietly(task: Awaitable[None]) -> None:
    try:
        await task
    except asyncio.CancelledError:
        return


def free_port() -> int:
    """A port that nobody listens on."""
    import socket

    with socket.create_server((HOST, 0)) as server:
        return int(server.getsockname()[1])
