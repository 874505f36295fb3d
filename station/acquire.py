"""Scan plan + turntable + scanner -> views, each on disk before anybody measures it."""

import asyncio
import hashlib
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass

import numpy as np

from drivers.errors import BadReply, DeviceFault
from drivers.scanner import Scanner
from drivers.turntable import Turntable
from drivers.wire.scanner import RangeFrame
from geometry.transforms import about_z, apply, inverse
from geometry.types import Floats, View
from station.events import MAX_VIEW_POINTS, Event, ViewCaptured, pack

Keep = Callable[[RangeFrame, float], Awaitable[None]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanPlan:
    """Where to look from, and how the table must stand meanwhile."""

    angles_deg: tuple[float, ...]
    tolerance_deg: float
    T_scanner_table0: Floats


async def scan_part(
    turntable: Turntable, scanner: Scanner, plan: ScanPlan, keep: Keep, emit: Callable[[Event], None]
) -> AsyncIterator[View]:
    """Each view of the scan plan in order, kept by `keep` before it is yielded.

    Every failure is a `drivers.errors.DriverError`; there is no such thing as a scan with a view left out.
    """
    await scanner.prepare()
    seen: set[str] = set()
    for index, angle_deg in enumerate(plan.angles_deg):
        rest_deg = await turntable.move_to(angle_deg)
        frame = await scanner.capture()
        await check_at_rest(turntable, rest_deg, plan.tolerance_deg)
        await check_new(scanner, frame, seen)
        await keep(frame, rest_deg)
        view = View(index=index, angle_deg=rest_deg, points_mm=frame.points_mm)
        emit(captured(view, len(plan.angles_deg), plan.T_scanner_table0))
        yield view


async def check_at_rest(turntable: Turntable, rest_deg: float, tolerance_deg: float) -> None:
    """Raises `DeviceFault` if the table moved while the scanner exposed."""
    status = await turntable.status()
    if status.busy or not abs(status.angle_deg - rest_deg) <= tolerance_deg:
        what = f"moved from {rest_deg:.4f} to {status.angle_deg:.4f} deg while the scanner exposed"
        raise DeviceFault("turntable", turntable.port, what)


async def check_new(scanner: Scanner, frame: RangeFrame, seen: set[str]) -> None:
    """Raises `BadReply` for a surface that came before under another index: noise never repeats itself."""
    digest = await asyncio.to_thread(lambda: hashlib.sha256(frame.points_mm.tobytes()).hexdigest())
    if len(frame.points_mm) and digest in seen:
        raise BadReply("scanner", scanner.host, f"frame {frame.frame_index} repeats an earlier surface")
    seen.add(digest)


def captured(view: View, total: int, T_scanner_table0: Floats) -> ViewCaptured:
    """The event of a view: its sample stands in the table frame at 0 degrees."""
    step = -(-len(view.points_mm) // MAX_VIEW_POINTS) or 1
    T_table0_scanner = inverse(T_scanner_table0 @ about_z(view.angle_deg))
    return ViewCaptured(
        index=view.index,
        total=total,
        angle_deg=view.angle_deg,
        points=len(view.points_mm),
        sample_mm=pack(apply(T_table0_scanner, np.asarray(view.points_mm[::step]))),
    )
