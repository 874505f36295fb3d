"""The worker process: crashes and hangs become typed errors, and the next start makes a new process."""

import asyncio
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from geometry.types import View
from station.worker import GeometryWorker, WorkerDied, WorkerFailed, WorkerTimeout

HERE = Path(__file__).parent
START_S = 60.0


@pytest.fixture(autouse=True)
def desks(monkeypatch: pytest.MonkeyPatch) -> None:
    """The spawned process imports the desks by name."""
    monkeypatch.syspath_prepend(str(HERE))


def worker_of(name: str) -> GeometryWorker:
    import live_desk

    return GeometryWorker(getattr(live_desk, name))


@pytest.fixture
def workers() -> Iterator[list[GeometryWorker]]:
    opened: list[GeometryWorker] = []
    yield opened
    for worker in opened:
        worker.close()


def view(index: int, points: int) -> View:
    return View(index=index, angle_deg=30.0 * index, points_mm=np.zeros((points, 3)))


async def test_a_part_is_absorbed_and_concluded(workers: list[GeometryWorker]) -> None:
    import live_desk

    worker = worker_of("counting")
    workers.append(worker)
    await worker.start(START_S)
    pid = worker.pid
    for _ in range(2):
        steps: list[str] = []
        await worker.begin(1, 10.0)
        for index in range(3):
            await worker.absorb(view(index, 1000), 10.0)
        measurement = await worker.conclude(10.0, steps.append)
        assert measurement.points == 3000
        await asyncio.sleep(0)
        assert steps == ["register"]
    await worker.start(START_S)
    assert worker.pid == pid
    assert await worker.perform(live_desk.begun, timeout_s=10.0) == [1, 1]


async def test_the_process_inherits_no_socket(workers: list[GeometryWorker]) -> None:
    import live_desk

    with socket.create_server(("127.0.0.1", 0)) as server:
        inode = f"socket:[{os.fstat(server.fileno()).st_ino}]"
        worker = worker_of("counting")
        workers.append(worker)
        await worker.start(START_S)
        assert inode not in await worker.perform(live_desk.inherited, timeout_s=10.0)


@pytest.mark.parametrize(("desk", "error"), [("crashing", WorkerDied), ("slow", WorkerTimeout)])
async def test_a_crash_or_a_hang_is_an_error_and_then_there_is_a_new_process(
    workers: list[GeometryWorker], desk: str, error: type[WorkerFailed]
) -> None:
    worker = worker_of(desk)
    workers.append(worker)
    await worker.start(START_S)
    first = worker.pid
    begun_s = time.monotonic()
    with pytest.raises(error, match=r"SIGSEGV|no answer"):
        await worker.conclude(0.5, lambda step: None)
    assert time.monotonic() - begun_s < 10.0
    assert not worker.alive
    with pytest.raises(WorkerDied):
        await worker.begin(1, 1.0)
    await worker.start(START_S)
    assert worker.alive
    assert worker.pid != first


async def test_killed_from_outside(workers: list[GeometryWorker]) -> None:
    worker = worker_of("slow")
    workers.append(worker)
    await worker.start(START_S)
    concluding = asyncio.create_task(worker.conclude(30.0, lambda step: None))
    await asyncio.sleep(0.05)
    assert worker.pid is not None
    os.kill(worker.pid, signal.SIGKILL)
    with pytest.raises(WorkerDied, match="SIGKILL"):
        await concluding


async def test_a_cancelled_order_leaves_no_half_answered_process(workers: list[GeometryWorker]) -> None:
    worker = worker_of("slow")
    workers.append(worker)
    await worker.start(START_S)
    concluding = asyncio.create_task(worker.conclude(30.0, lambda step: None))
    await asyncio.sleep(0.05)
    concluding.cancel()
    with pytest.raises(asyncio.CancelledError):
        await concluding
    assert not worker.alive


async def test_an_exception_is_one_line_and_the_process_lives(workers: list[GeometryWorker]) -> None:
    worker = worker_of("failing")
    workers.append(worker)
    await worker.start(START_S)
    with pytest.raises(WorkerFailed, match=r"^ValueError: a line$"):
        await worker.conclude(10.0, lambda step: None)
    assert worker.alive


async def test_a_desk_that_cannot_be_made(workers: list[GeometryWorker]) -> None:
    worker = worker_of("broken")
    workers.append(worker)
    with pytest.raises(WorkerFailed, match="no such nominal"):
        await worker.start(START_S)


ORPHAN = """
import asyncio, sys
sys.path.insert(0, sys.argv[1])
import live_desk
from station.worker import GeometryWorker

async def main():
    worker = GeometryWorker(live_desk.slow)
    await worker.start(60.0)
    print(worker.pid, flush=True)
    await worker.conclude(600.0, lambda step: None)

if __name__ == "__main__":
    asyncio.run(main())
"""


def test_the_process_leaves_with_its_parent(tmp_path: Path) -> None:
    script = tmp_path / "orphan.py"
    script.write_text(ORPHAN)
    environment = os.environ | {"PYTHONPATH": str(HERE.parents[1])}
    parent = subprocess.Popen(
        [sys.executable, str(script), str(HERE)], stdout=subprocess.PIPE, env=environment
    )
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    deadline_s = time.monotonic() + 10.0
    while Path(f"/proc/{pid}").exists() and time.monotonic() < deadline_s:
        if "Z" in Path(f"/proc/{pid}/stat").read_text().split(")")[1]:
            break
        time.sleep(0.02)
    else:
        assert not Path(f"/proc/{pid}").exists()
    parent.stdout.close()
