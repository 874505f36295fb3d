"""The geometry worker: one warm process that measures, so that nothing it does can stop the cell.

A native crash, a kill for want of memory or a hang become `WorkerDied` or `WorkerTimeout`; the process is
then gone and `start` makes a new one. It is spawned, so it inherits no socket, and leaves with its parent.
Orders go through a pipe that only a thread of its own waits on: the event loop never does.
"""

import asyncio
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any, Protocol

from geometry.types import View
from station.measurement import Measurement

Progress = Callable[[str], None]


class WorkerFailed(Exception):
    """The worker gives no measurement; its text is one line for a person."""


class WorkerDied(WorkerFailed):
    """The process ended by itself: a crash, or somebody killed it."""


class WorkerTimeout(WorkerFailed):
    """The process did not answer in time and was ended."""


class Desk(Protocol):
    """What the process does between two orders. It is made in the process, warm, by a `DeskMaker`."""

    def begin(self, recipe: int) -> None:
        """Forget the part before."""

    def absorb(self, view: View) -> None:
        """Take one view."""

    def conclude(self, progress: Progress) -> Measurement:
        """Measure what was taken, telling each step as it begins."""

    def perform(self, task: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
        """Run `task(recipe, measurement, *arguments)` on the part that was measured last."""


DeskMaker = Callable[[], Desk]


class GeometryWorker:
    """The parent's end. One order at a time."""

    def __init__(self, make_desk: DeskMaker) -> None:
        self._make_desk = make_desk
        self._process: SpawnProcess | None = None
        self._pipe: Connection | None = None
        self._thread = ThreadPoolExecutor(1, "worker-pipe")
        self._busy = False

    @property
    def alive(self) -> bool:
        """Whether there is a process that waits for orders."""
        return self._process is not None and self._process.is_alive() and not self._busy

    @property
    def pid(self) -> int | None:
        """The process id, for those who want to see it die."""
        return self._process.pid if self._process else None

    async def start(self, timeout_s: float) -> None:
        """Returns when a process is warm: the one that is there, or a new one."""
        if self.alive:
            return
        self.kill()
        context = multiprocessing.get_context("spawn")
        self._pipe, far_end = context.Pipe()
        self._process = context.Process(
            target=serve, args=(far_end, self._make_desk), name="bladecell-geometry", daemon=True
        )
        self._process.start()
        far_end.close()
        try:
            await self._answer(self._pipe, None, timeout_s, _ignore)
        except WorkerFailed:
            self.kill()
            raise

    async def begin(self, recipe: int, timeout_s: float) -> None:
        """Turns to a new part."""
        await self._order("begin", (recipe,), timeout_s)

    async def absorb(self, view: View, timeout_s: float) -> None:
        """Hands over one view."""
        await self._order("absorb", (view,), timeout_s)

    async def conclude(self, timeout_s: float, progress: Progress) -> Measurement:
        """The measurement of the views handed over since `begin`."""
        loop = asyncio.get_running_loop()

        def tell(step: str) -> None:
            loop.call_soon_threadsafe(progress, step)

        measurement = await self._order("conclude", (), timeout_s, tell)
        if not isinstance(measurement, Measurement):
            raise WorkerFailed(f"the worker answered with {type(measurement).__name__}")
        return measurement

    async def perform(self, task: Callable[..., Any], *arguments: Any, timeout_s: float) -> Any:
        """What `task(recipe, measurement, *arguments)` returns in the process, for the part measured last."""
        return await self._order("perform", (task, arguments), timeout_s)

    def kill(self) -> None:
        """Ends the process at once, whatever it does."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
        if self._pipe is not None:
            self._pipe.close()
        self._process = self._pipe = None
        self._busy = False

    def close(self) -> None:
        """Ends process and thread."""
        self.kill()
        self._thread.shutdown(wait=True)

    async def _order(
        self, name: str, arguments: tuple[Any, ...], timeout_s: float, progress: Progress | None = None
    ) -> Any:
        if self._pipe is None or not self.alive:
            raise WorkerDied("there is no geometry worker")
        return await self._answer(self._pipe, (name, arguments), timeout_s, progress or _ignore)

    async def _answer(self, pipe: Connection, order: object, timeout_s: float, progress: Progress) -> Any:
        """The answer to an order; a worker that was not waited for to the end is killed, never reused."""
        loop = asyncio.get_running_loop()
        self._busy = True
        try:
            async with asyncio.timeout(timeout_s):
                failed, value = await loop.run_in_executor(self._thread, _exchange, pipe, order, progress)
        except TimeoutError:
            self.kill()
            raise WorkerTimeout(f"no answer within {timeout_s:g} s") from None
        except (EOFError, OSError) as error:
            code = self._exit_code()
            self.kill()
            raise WorkerDied(f"the geometry worker ended ({code})") from error
        except BaseException:
            self.kill()
            raise
        self._busy = False
        if failed:
            raise WorkerFailed(str(value))
        return value

    def _exit_code(self) -> str:
        if self._process is None:
            return "never started"
        self._process.join(1.0)
        code = self._process.exitcode
        return signal.Signals(-code).name if code is not None and code < 0 else f"exit status {code}"


def _exchange(pipe: Connection, order: object, progress: Progress) -> tuple[bool, Any]:
    """Whether the order failed, and its value or why."""
    if order is not None:
        pipe.send(order)
    while True:
        kind, value = pipe.recv()
        if kind == "step":
            progress(value)
        else:
            return kind == "failed", value


def _ignore(_step: str) -> None:
    pass


def serve(pipe: Connection, make_desk: DeskMaker) -> None:
    """The process: makes its desk, then answers orders until the parent is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    desk = _reply(pipe, make_desk)
    while desk is not None:
        try:
            name, arguments = pipe.recv()
        except EOFError:
            return
        match name:
            case "begin":
                _reply(pipe, desk.begin, *arguments)
            case "absorb":
                _reply(pipe, desk.absorb, *arguments)
            case "conclude":
                _reply(pipe, desk.conclude, lambda step: pipe.send(("step", step)), tell=True)
            case "perform":
                _reply(pipe, desk.perform, *arguments, tell=True)


def _reply(pipe: Connection, call: Callable[..., Any], *arguments: Any, tell: bool = False) -> Any:
    """Does the call and answers; the value itself travels only when asked for."""
    try:
        value = call(*arguments)
    except Exception as error:  # whatever went wrong here, the cell must hear of it
        pipe.send(("failed", f"{type(error).__name__}: {error}".splitlines()[0]))
        return None
    pipe.send(("done", value if tell else None))
    return value


def _leave_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)
