"""`python -m simulators serve`: a whole cell on the wire, until it is told to end."""

import argparse
import asyncio
import contextlib
import json
import signal
import sys
import time
from collections.abc import Coroutine, Sequence
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import Any, TextIO

from simulators.cell import (
    BadJob,
    LoadedPart,
    Order,
    RecordedParts,
    SimCell,
    Studio,
    StudioFailed,
    read_job,
)
from simulators.faults import Faults
from simulators.plc import PlcProgram, run_plc
from simulators.preset_names import PRESETS, preset_named
from simulators.scanner import ScannerPorts, serve_scanner
from simulators.serve import ByteServer, serve_pty, serve_tcp
from simulators.station_files import Addresses, free_port, write_station
from simulators.turntable import TurntableSession

HOST = "127.0.0.1"
_ALERT_S = 0.02


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status: 0 after SIGTERM or SIGINT, 2 for what cannot be served."""
    options = _parser().parse_args(arguments)
    try:
        asyncio.run(serve(options))
    except (BadJob, StudioFailed, OSError) as error:
        print(f"simulators: {error}", file=sys.stderr)
        return 2
    return 0


async def serve(options: argparse.Namespace) -> None:
    """Serve the cell until SIGTERM or SIGINT; prints its addresses once everything listens."""
    serving = asyncio.ensure_future(_serve(options))
    for interruption in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(interruption, serving.cancel)
    with contextlib.suppress(asyncio.CancelledError):
        await serving


async def _serve(options: argparse.Namespace) -> None:
    failed = asyncio.Event()
    async with AsyncExitStack() as stack:
        cell = _cell(options, stack)
        await cell.load(0)
        addresses = await _listen(cell, options, stack)
        if options.write_config:
            calibration, plan = await cell.parts.write_files(options.write_config.parent)
            write_station(options.write_config, addresses, cell.scanner.serial, calibration, plan)
        if "plc" not in options.without:
            _start_plc(cell, options, addresses, stack, failed)
        print(addresses.line() if options.json else _readable(addresses), flush=True)
        await failed.wait()


def _cell(options: argparse.Namespace, stack: AsyncExitStack) -> SimCell:
    truths = _open_log(options.truth_log, stack)
    parts = _parts(options)
    stack.callback(parts.close)
    cell = SimCell(parts=parts, clock=time.monotonic, on_load=partial(_write_truth, truths))
    if isinstance(parts, RecordedParts):
        cell.scanner.serial = parts.jobs[0].scanner_serial
    return cell


def _parts(options: argparse.Namespace) -> Studio | RecordedParts:
    if options.replay:
        return RecordedParts(tuple(read_job(folder) for folder in options.replay))
    order = Order(preset=options.preset, seed=options.seed, nominal=options.nominal)
    return Studio(order, ahead="plc" not in options.without and options.parts != 1)


async def _listen(cell: SimCell, options: argparse.Namespace, stack: AsyncExitStack) -> Addresses:
    """Put every device that is not left out on the wire."""
    port = _ports(options.ports)
    tcp, pty = port["turntable"], None
    if "turntable" not in options.without:
        tcp, pty = await _serve_turntable(cell, tcp, stack)
    ports = ScannerPorts(modbus=port["modbus"], control=port["control"], data=port["data"])
    if "scanner" not in options.without:
        ports = await stack.enter_async_context(
            serve_scanner(cell.scanner, cell.expose, host=HOST, ports=ports, clock=cell.clock)
        )
    return Addresses(
        host=HOST,
        turntable_tcp=tcp,
        turntable_pty=pty,
        modbus=ports.modbus,
        control=ports.control,
        data=ports.data,
        station_modbus=port["station"],
        events=port["events"],
    )


def _first_port(text: str) -> int:
    first = int(text)
    if not 1 <= first <= 65535 - 5:
        raise argparse.ArgumentTypeError(f"{first} is no port with five more after it")
    return first


def _ports(first: int | None) -> dict[str, int]:
    names = ("turntable", "modbus", "control", "data", "station", "events")
    if first is not None:
        return dict(zip(names, range(first, first + len(names)), strict=True))
    return {name: free_port(HOST) for name in names}


async def _serve_turntable(cell: SimCell, port: int, stack: AsyncExitStack) -> tuple[int, str]:
    def session() -> TurntableSession:
        return TurntableSession(cell.turntable, cell.clock)

    tcp = await stack.enter_async_context(serve_tcp(HOST, port, session, Faults()))
    cable = await stack.enter_async_context(serve_pty(session(), Faults()))
    _run(_alert(cell, (tcp, cable)), stack)
    return tcp.port, cable.path


async def _alert(cell: SimCell, servers: Sequence[ByteServer]) -> None:
    """Tell every client when a motion ends, if the device was asked to."""
    while True:
        line = cell.turntable.alert(cell.clock())
        for server in servers if line is not None else ():
            server.broadcast((line or b"") + b"\r\n")
        await asyncio.sleep(_ALERT_S)


def _start_plc(
    cell: SimCell,
    options: argparse.Namespace,
    addresses: Addresses,
    stack: AsyncExitStack,
    failed: asyncio.Event,
) -> None:
    """Start the PLC. The time stands in for its retentive memory: no two runs use the same sequence."""
    now = int(time.time())
    program = PlcProgram(first_sequence=now & 0x7FFF_FFFF, epoch=now % 0xFFFF + 1, parts=options.parts)
    log = _open_log(options.plc_log, stack) or sys.stderr
    task = _run(
        run_plc(program, HOST, addresses.station_modbus, load=cell.load, report=partial(_write_line, log)),
        stack,
    )
    # It runs for ever: its end is a failure, and must not pass for a quiet PLC.
    task.add_done_callback(lambda _: failed.set())


def _run(work: Coroutine[Any, Any, None], stack: AsyncExitStack) -> "asyncio.Task[None]":
    """A task that lives as long as the cell, and whose failure then comes out."""
    task: asyncio.Task[None] = asyncio.get_running_loop().create_task(work)

    async def end() -> None:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task

    stack.push_async_callback(end)
    return task


def _open_log(path: Path | None, stack: AsyncExitStack) -> TextIO | None:
    return stack.enter_context(path.open("a", encoding="utf-8")) if path else None


def _write_truth(log: TextIO | None, part: LoadedPart) -> None:
    if log is not None and part.truth is not None:
        _write_line(log, {"serial": part.serial, "index": part.index, **part.truth})


def _write_line(log: TextIO, line: dict[str, Any]) -> None:
    with contextlib.suppress(OSError):  # the cell outlives whoever reads its log
        log.write(json.dumps(line) + "\n")
        log.flush()


def _readable(addresses: Addresses) -> str:
    return (
        f"turntable  {HOST}:{addresses.turntable_tcp}, pty {addresses.turntable_pty}\n"
        f"scanner    modbus {addresses.modbus}, control {addresses.control}, data {addresses.data}\n"
        f"plc        polls the station at {HOST}:{addresses.station_modbus}"
    )


def _preset(text: str) -> str:
    try:
        return preset_named(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m simulators", description=__doc__)
    serve = parser.add_subparsers(required=True).add_parser("serve", help="serve a cell until SIGTERM")
    add = serve.add_argument
    add("--seed", type=int, default=0, help="of parts, noise and rig")
    add("--preset", type=_preset, default="demo", help="which parts come: " + ", ".join(PRESETS))
    add("--nominal", type=Path, help="mesh file of the part number; default: the thesis blade")
    add("--json", action="store_true", help="print the addresses as one line of JSON")
    add("--write-config", type=Path, metavar="FILE", help="write a station configuration")
    add("--without", action="append", default=[], choices=["turntable", "scanner", "plc"])
    add("--replay", action="append", default=[], type=Path, metavar="JOB", help="serve recorded frames")
    add("--ports", type=_first_port, metavar="BASE", help="first of six ports; default: free ones")
    add("--parts", type=int, help="how many parts the PLC loads; default: no end")
    add("--plc-log", type=Path, metavar="FILE", help="what the PLC latched, one JSON object a line")
    add("--truth-log", type=Path, metavar="FILE", help="what was loaded, one JSON object a line")
    return parser


if __name__ == "__main__":
    sys.exit(main())
