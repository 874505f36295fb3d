"""The live station on the wire: real drivers, real records, a PLC of independent make."""

import asyncio
import json
import os
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import pytest_asyncio

from drivers.wire.plc import Ctrl, FaultCode, StatusBits, decode_result
from station import cell, record
from station.events import (
    Acknowledge,
    AlarmRaised,
    CloudMeasured,
    PartRecorded,
    Reset,
    SectionMeasured,
    Start,
    StationStatus,
    Stop,
    VerdictAcknowledged,
    VerdictReached,
    ViewCaptured,
)
from station.journal import job_folder
from station.operate import to_its_end
from station.phases import State
from station.record import AnotherStation, Request, read_requests, verify

if TYPE_CHECKING:
    from live_rig import Rig

HERE = Path(__file__).parent
READY, START_ACK, BUSY = StatusBits.READY, StatusBits.START_ACK, StatusBits.BUSY
VALID, FAULT, ABORTED = StatusBits.RESULT_VALID, StatusBits.FAULT, StatusBits.ABORTED
UP = Ctrl.ENABLE | Ctrl.PART_PRESENT

Stations = Callable[..., AbstractAsyncContextManager["Rig"]]


pytestmark = pytest.mark.asyncio(loop_scope="module")


@pytest.fixture(scope="module")
def station() -> Iterator[Stations]:
    """Opens stations; the worker's process imports its desk by name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(HERE))
        import live_rig

        yield live_rig.station


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def opened(station: Stations, tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator["Rig"]:
    """One station for all tests that leave it ready."""
    async with station(tmp_path_factory.mktemp("live")) as rig:
        yield rig


@pytest_asyncio.fixture(loop_scope="module")
async def rig(opened: "Rig") -> "Rig":
    """The station, ready, with its events forgotten; its next request has the sequence `rig.sequence`."""
    if await opened.plc.status() & FAULT:  # left by a test that failed
        await opened.plc.write(ctrl=UP)
        await asyncio.sleep(0.2)
        await opened.plc.write(ctrl=UP | Ctrl.RESET_FAULT)
    await opened.plc.until_bits(READY)
    opened.events.clear()
    opened.sequence += 10
    return opened


def requests_since(rig: "Rig") -> list[Request]:
    """The requests of this test."""
    return [r for r in read_requests(rig.folder / "record") if r.ticket.sequence >= rig.sequence]


def result(block: list[int]) -> Any:
    return decode_result(block[4:])


async def judged(rig: "Rig", recipe: int = 1) -> Any:
    """The result of one more request, acknowledged; the sequence goes on."""
    rig.sequence += 1
    await rig.plc.ask(rig.sequence, f"SN-{rig.sequence}", recipe)
    published = result(await rig.plc.until_bits(VALID, BUSY))
    await rig.plc.answer(rig.sequence)
    assert (published.sequence, published.serial) == (rig.sequence, f"SN-{rig.sequence}")
    return published


async def test_three_parts_and_what_is_left_of_them(rig: "Rig") -> None:
    plc, first = rig.plc, rig.sequence
    numbers = []
    for sequence, (recipe, word) in enumerate([(1, "PASS"), (2, "REPAIR"), (3, "SCRAP")], first):
        await plc.ask(sequence, f"SN-{sequence}", recipe)
        block = await plc.until_bits(START_ACK | BUSY)
        assert not any(block[4:])
        block = await plc.until_bits(VALID, BUSY)
        assert block[0] & (START_ACK | READY) == START_ACK
        published = result(block)
        assert published.verdict.name == word
        assert (published.sequence, published.serial) == (sequence, f"SN-{sequence}")
        assert published.reason == {"PASS": 0, "REPAIR": 421, "SCRAP": 451}[word]
        numbers.append(published.record_id)
        await plc.answer(sequence)
        await plc.until_bits(READY)
    rig.sequence = first
    requests = requests_since(rig)
    assert [(r.record_no, r.verdict, r.phase, r.ack_code) for r in requests] == [
        (numbers[0], "PASS", "ACKED", 1),
        (numbers[1], "REPAIR", "ACKED", 1),
        (numbers[2], "SCRAP", "ACKED", 1),
    ]
    assert verify(rig.folder / "record") == ()
    check_job(job_folder(rig.folder / "record", numbers[1]), rig, f"SN-{first + 1}")
    assert len(rig.of(ViewCaptured)) == 9
    assert len(rig.of(VerdictReached)) == len(rig.of(VerdictAcknowledged)) == 3
    assert len(rig.of(CloudMeasured)) == len(rig.of(SectionMeasured)) == 3
    assert rig.of(PartRecorded)[-1].acknowledged  # type: ignore[union-attr]


def check_job(folder: Path, rig: "Rig", serial: str) -> None:
    """The folder holds all that a replay and an auditor need."""
    frames = json.loads((folder / "frames.json").read_text())
    assert [frame["angle_deg"] for frame in frames] == pytest.approx([0.0, 90.0, 180.0], abs=0.01)
    indices = [frame["frame_index"] for frame in frames]
    assert indices == list(range(indices[0], indices[0] + 3))
    assert json.loads((folder / "ticket.json").read_text())["serial"] == serial
    inputs = json.loads((folder / "inputs.json").read_text())
    assert set(inputs) == {"configuration", "calibration", "plan", "nominal"}
    for kept in inputs.values():
        assert (folder / kept["file"]).is_file()
    assert json.loads((folder / "result.json").read_text())["verdict"] == "REPAIR"
    for name in ("report.html", "deviation.ply", "twin.ply", "repair-1.stl", "measurement.json"):
        assert (folder / name).is_file()
    assert json.loads((folder / "devices.json").read_text())["scanner"]["serial"] == rig.scanner.serial


async def test_a_part_that_is_taken_away_ends_without_a_verdict(rig: "Rig") -> None:
    plc = rig.plc
    await plc.ask(rig.sequence)
    await plc.until_bits(START_ACK | BUSY)
    await plc.write(ctrl=Ctrl.ENABLE | Ctrl.START)
    block = await plc.until_bits(ABORTED, BUSY | START_ACK)
    assert not any(block[4:])
    await plc.write(ctrl=UP)
    await plc.until_bits(READY)
    await plc.ask(rig.sequence)
    block = await plc.until(lambda block: block[9] != 0)
    assert block[9] == FaultCode.NEW_SEQUENCE_NEEDED
    await plc.write(ctrl=UP)
    await plc.until_bits(READY)
    (request,) = requests_since(rig)
    assert (request.verdict, request.phase) == ("HOLD", "DECIDED")
    assert verify(rig.folder / "record") == ()


async def test_refusals(rig: "Rig") -> None:
    plc = rig.plc
    for change, code in (({"recipe": 99}, FaultCode.UNKNOWN_RECIPE), ({"serial": None}, 2)):
        await plc.write(sequence=rig.sequence, ctrl=UP | Ctrl.START, **{"serial": "SN-1", **change})
        block = await plc.until(lambda block: block[9] != 0)
        assert block[9] == code
        assert not block[0] & (READY | START_ACK | BUSY | VALID | FAULT)
        await plc.write(ctrl=UP, recipe=1)
        assert not any((await plc.until_bits(READY))[4:])
    assert requests_since(rig) == []


@pytest.mark.parametrize(("recipe", "reason"), [(5, 216), (6, 215), (4, 209)])
async def test_a_worker_that_crashes_or_hangs_gives_hold_and_the_cell_lives(
    rig: "Rig", recipe: int, reason: int
) -> None:
    published = await judged(rig, recipe)
    assert (published.verdict.name, published.reason) == ("HOLD", reason)
    await rig.plc.until_bits(READY, FAULT)


async def test_a_lost_trigger_is_sent_once_more(rig: "Rig") -> None:
    rig.scanner.lose_triggers = 1
    assert (await judged(rig)).verdict.name == "PASS"


async def test_two_lost_triggers_are_a_hold_and_no_fault(rig: "Rig") -> None:
    rig.scanner.lose_triggers = 2
    published = await judged(rig)
    assert (published.verdict.name, published.reason) == ("HOLD", 201)
    await rig.plc.until_bits(READY, FAULT)


async def test_a_stalled_table_is_a_hold_and_a_fault_until_reset(rig: "Rig") -> None:
    plc = rig.plc
    rig.turntable.stall_after(200_000, time.monotonic())
    await plc.ask(rig.sequence)
    published = result(await plc.until_bits(VALID))
    assert (published.verdict.name, published.reason) == ("HOLD", 102)
    await plc.until_bits(FAULT | VALID, READY)
    await plc.answer(rig.sequence)  # a published verdict is answered in any state
    await plc.until_bits(FAULT, VALID | READY)
    assert any(e.number == 102 and e.first_out for e in rig.of(AlarmRaised))  # type: ignore[union-attr]
    await plc.write(ctrl=UP | Ctrl.RESET_FAULT)
    await plc.until_bits(READY, FAULT)
    await plc.write(ctrl=UP)
    assert (await judged(rig)).verdict.name == "PASS"


async def test_a_table_that_was_switched_off_while_idle_is_noticed(rig: "Rig") -> None:
    rig.turntable.restart(time.monotonic())
    await rig.plc.until_bits(FAULT, READY)
    assert any(e.number == 103 for e in rig.of(AlarmRaised))  # type: ignore[union-attr]
    await rig.plc.write(ctrl=UP | Ctrl.RESET_FAULT)
    await rig.plc.until_bits(READY, FAULT)
    await rig.plc.write(ctrl=UP)


async def test_a_silent_plc_interrupts_and_its_return_makes_ready(rig: "Rig") -> None:
    plc = rig.plc
    await plc.ask(rig.sequence, recipe=7)
    await plc.until_bits(START_ACK | BUSY)
    plc.beating = False
    await plc.until_bits(ABORTED | StatusBits.PLC_LOST, BUSY | START_ACK)
    plc.beating = True
    await plc.write(ctrl=UP)
    await plc.until_bits(READY, StatusBits.PLC_LOST)
    assert [r.verdict for r in requests_since(rig)] == ["HOLD"]


async def test_a_changed_plan_is_a_hold(rig: "Rig") -> None:
    plan = rig.folder / "plan.toml"
    before = plan.read_text()
    plan.write_text(before.replace("repairable = 15.0", "repairable = 99.0"))
    published = await judged(rig)
    assert (published.verdict.name, published.reason) == ("HOLD", 133)
    plan.write_text(before)
    await rig.plc.write(ctrl=UP | Ctrl.RESET_FAULT)
    await rig.plc.until_bits(READY)
    await rig.plc.write(ctrl=UP)


async def test_the_loop_never_waits(rig: "Rig") -> None:
    """Lag of the event loop over a whole part, with disk and worker at work."""
    lags: list[float] = []

    async def measure() -> None:
        while True:
            before_s = time.monotonic()
            await asyncio.sleep(0.01)
            lags.append(time.monotonic() - before_s - 0.01)

    measuring = asyncio.create_task(measure())
    await judged(rig)
    await rig.plc.until_bits(READY)
    measuring.cancel()
    assert sorted(lags)[int(0.95 * len(lags))] < 0.1


async def test_an_answer_that_the_store_refused_is_entered_after_the_reset(
    station: Stations, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with station(tmp_path) as rig:
        await delivered(rig)
        fail_once(monkeypatch, "ACKED")
        await rig.plc.write(ctrl=UP | Ctrl.RESULT_ACK, ack_sequence=1, ack_code=1)
        await rig.plc.until_bits(VALID | FAULT)
        operator_resets(rig)
        await rig.plc.until_bits(StatusBits(0), VALID | FAULT)
        await rig.plc.write(ctrl=UP)
        await rig.plc.until_bits(READY)
        assert (rig.cell.record.request(1).phase, rig.cell.record.request(1).ack_code) == ("ACKED", 1)
    assert verify(tmp_path / "record") == ()


async def test_an_answer_while_the_record_is_read_anew_waits_for_it(
    station: Stations, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_chain = record.chain

    def slowly(db: Any) -> Iterator[Any]:
        time.sleep(2.5)
        yield from read_chain(db)

    async with station(tmp_path) as rig:
        fail_once(monkeypatch, "PUBLISHED")
        await rig.plc.until_bits(READY)
        await rig.plc.ask(1)
        await rig.plc.until_bits(VALID | FAULT)
        await rig.cell.until(lambda: rig.cell.state is State.ABORTED)
        monkeypatch.setattr(record, "chain", slowly)
        operator_resets(rig)
        await asyncio.sleep(0.5)
        assert rig.cell.record.failed
        await rig.plc.write(ctrl=UP | Ctrl.RESULT_ACK, ack_sequence=1, ack_code=1)
        await rig.plc.until_bits(StatusBits(0), VALID | FAULT)
        assert not rig.running.done()
        assert rig.cell.record.request(1).phase == "ACKED"


@pytest.mark.parametrize("phase", ["MEASURING", "PUBLISHED"])
async def test_a_disk_that_stalls_is_a_fault_in_time_and_loses_nothing(
    station: Stations, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, phase: str
) -> None:
    goes_on = threading.Event()
    monkeypatch.setattr(cell, "DISK_S", 1.0)
    monkeypatch.setattr(cell, "REOPEN_S", 0.5)
    async with station(tmp_path) as rig:
        await rig.plc.until_bits(READY)
        await rig.plc.ask(1)
        await rig.plc.until_bits(VALID if phase == "PUBLISHED" else START_ACK | BUSY)
        await rig.cell.until(lambda: rig.cell.record.request(1).phase != "DECIDED")
        rig.cell.disk.submit(goes_on.wait, 30.0)
        if phase == "PUBLISHED":
            await rig.plc.write(ctrl=UP | Ctrl.RESULT_ACK, ack_sequence=1, ack_code=1)
        await rig.plc.until_bits(FAULT, BUSY)
        operator_resets(rig)
        await rig.cell.until(lambda: rig.cell.state is State.CLEARING)
        await rig.cell.until(lambda: rig.cell.state is State.ABORTED)  # it stalls still
        assert rig.cell.record.failed
        goes_on.set()
        operator_resets(rig)
        await rig.plc.until_bits(StatusBits(0), VALID | FAULT)
        await rig.plc.write(ctrl=UP)
        await rig.plc.until_bits(READY)
        expected = ("ACKED", "PASS") if phase == "PUBLISHED" else ("DECIDED", "HOLD")
        assert (rig.cell.record.request(1).phase, rig.cell.record.request(1).verdict) == expected
    assert verify(tmp_path / "record") == ()


async def delivered(rig: "Rig") -> None:
    await rig.plc.until_bits(READY)
    await rig.plc.ask(1)
    await rig.plc.until_bits(VALID, BUSY)
    await rig.cell.until(lambda: rig.cell.record.request(1).phase == "PUBLISHED")


def fail_once(patch: pytest.MonkeyPatch, phase: str) -> None:
    """The disk is full when the next entry of this phase was just committed."""
    write_anchor = record.write_anchor

    def full(directory: Path, entry: Any) -> None:
        if entry.phase == phase:
            patch.setattr(record, "write_anchor", write_anchor)
            raise OSError(28, "No space left on device")
        write_anchor(directory, entry)

    patch.setattr(record, "write_anchor", full)


def operator_resets(rig: "Rig") -> None:
    rig.cell.intents.put_nowait(Acknowledge())
    rig.cell.intents.put_nowait(Reset())


async def test_a_station_that_waits_says_for_what(rig: "Rig") -> None:
    rig.cell.intents.put_nowait(Stop())
    await rig.plc.until_bits(StatusBits(0), READY)
    await rig.cell.until(lambda: rig.of(StationStatus)[-1].detail == "waits for START")  # type: ignore[union-attr]
    await rig.plc.write(ctrl=Ctrl.PART_PRESENT)
    rig.cell.intents.put_nowait(Start())
    await rig.cell.until(lambda: rig.of(StationStatus)[-1].detail == "waits for ENABLE of the PLC")  # type: ignore[union-attr]
    await rig.plc.write(ctrl=UP)
    await rig.plc.until_bits(READY)


async def test_a_second_station_finds_the_record_held(rig: "Rig", station: Stations) -> None:
    before = await rig.plc.read()
    with pytest.raises(AnotherStation):
        async with station(rig.folder, write=False):
            pass
    assert (await rig.plc.read())[0] == before[0]


async def test_a_verdict_stands_after_a_restart_and_an_interrupted_request_does_not(
    station: Stations, tmp_path: Path
) -> None:
    """Three lives of one station: told to end while a verdict stands, then in the middle of a part."""
    async with station(tmp_path) as rig:
        await rig.plc.until_bits(READY)
        await rig.plc.ask(41, "SN-41", 2)
        before = await rig.plc.until_bits(VALID)
        port = rig.plc.port
    async with station(tmp_path, plc_port=port) as rig:
        after = await rig.plc.until_bits(VALID)
        assert after[4:40] == before[4:40]
        assert after[2] != before[2]
        await rig.plc.write(ctrl=UP | Ctrl.RESULT_ACK, ack_sequence=41, ack_code=1)
        await rig.plc.until_bits(StatusBits(0), VALID)
        await rig.plc.write(ctrl=UP)
        await rig.plc.until_bits(READY)
        await rig.plc.ask(42, recipe=7)
        await rig.plc.until_bits(START_ACK | BUSY)
    acked, interrupted = read_requests(tmp_path / "record")
    assert acked.phase == "ACKED"
    assert interrupted.verdict == "HOLD"
    async with station(tmp_path, plc_port=port) as rig:
        await rig.plc.ask(42)  # still standing
        block = await rig.plc.until(lambda block: block[9] != 0)
        assert block[9] == FaultCode.NEW_SEQUENCE_NEEDED
        assert not block[0] & VALID
    assert verify(tmp_path / "record") == ()


async def killed(process: asyncio.subprocess.Process) -> None:
    process.kill()
    await process.wait()


@pytest.mark.timeout(400)
async def test_killed_twice_the_record_holds_and_nothing_is_told_twice(
    station: Stations, tmp_path: Path
) -> None:
    """kill -9 in mid-part, then while a verdict stands: each time the same command starts again."""
    import live_rig

    async def start() -> asyncio.subprocess.Process:
        script = [str(HERE / "live_station.py"), str(config)]
        environment = os.environ | {"PYTHONPATH": str(HERE.parents[1])}
        return await asyncio.create_subprocess_exec(sys.executable, *script, env=environment)

    async with live_rig.devices() as (_, scanner, ports):
        free = {"plc": live_rig.free_port(), "events": live_rig.free_port()}
        config = live_rig.write_files(
            tmp_path, ports | free, mode="SIMULATION", scanner_serial=scanner.serial
        )
        async with live_rig.Plc.talking(free["plc"]) as plc:
            process = await start()
            await plc.write()
            await plc.until_bits(READY)
            await plc.ask(1, recipe=7)
            await plc.until_bits(START_ACK | BUSY)
            await killed(process)
            assert verify(tmp_path / "record") == ()
            process = await start()
            await plc.ask(1, recipe=7)
            assert (await plc.until(lambda block: block[9] != 0))[9] == FaultCode.NEW_SEQUENCE_NEEDED
            await plc.write(ctrl=UP)
            await plc.until_bits(READY)
            await plc.ask(2, "SN-2", recipe=2)
            before = await plc.until_bits(VALID)
            await killed(process)
            assert verify(tmp_path / "record") == ()
            process = await start()
            after = await plc.until_bits(VALID)
            assert (after[4:40], after[2] - before[2]) == (before[4:40], 1)
            await plc.answer(2)
            process.terminate()
            assert await process.wait() == 0
    interrupted, answered = read_requests(tmp_path / "record")
    assert (interrupted.verdict, answered.verdict, answered.phase) == ("HOLD", "REPAIR", "ACKED")


async def test_maintenance_is_never_ready(station: Stations, tmp_path: Path) -> None:
    async with station(tmp_path, mode="MAINTENANCE") as rig:
        await rig.cell.until(lambda: rig.cell.state == "IDLE", 20.0)
        assert await rig.plc.status() & (READY | StatusBits.MANUAL) == StatusBits.MANUAL
        await rig.plc.ask(1)
        await asyncio.sleep(0.3)
        assert not await rig.plc.status() & (START_ACK | BUSY)
        assert rig.of(StationStatus)[-1].state == "IDLE"  # type: ignore[union-attr]


async def test_what_closes_a_request_is_done_to_its_end_however_often_it_is_stopped() -> None:
    done: list[str] = []

    async def closing() -> None:
        await asyncio.sleep(0.05)
        done.append("closed")

    task = asyncio.create_task(to_its_end(closing()))
    for _ in range(2):
        await asyncio.sleep(0.01)
        task.cancel()
    await task
    assert done == ["closed"]
