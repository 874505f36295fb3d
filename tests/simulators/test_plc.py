"""The simulated PLC: its program scan by scan in virtual time, then on the wire."""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import pairwise

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from drivers.plc import PlcLink
from drivers.wire.errors import BadReply
from drivers.wire.plc import (
    Ctrl,
    FaultCode,
    PlcRequest,
    ResultBlock,
    StatusBits,
    VerdictCode,
    decode_request,
    encode_request,
)
from simulators.plc import Line, Phase, PlcProgram, StationImage, decode_image, run_plc

READY = StatusBits.ONLINE | StatusBits.READY
BUSY = StatusBits.ONLINE | StatusBits.START_ACK | StatusBits.BUSY
VALID = StatusBits.ONLINE | StatusBits.START_ACK | StatusBits.RESULT_VALID
NOTHING = (0,) * 36


def verdict(request: PlcRequest, **change: object) -> ResultBlock:
    assert request.serial is not None
    block = ResultBlock(
        sequence=request.sequence,
        verdict=VerdictCode.REPAIR,
        serial=request.serial,
        record_id=1,
        time_ms=1_763_770_000_000,
    )
    return replace(block, **change)  # type: ignore[arg-type]


@dataclass
class Nest:
    """A program and the station that it sees, 50 ms a scan."""

    program: PlcProgram = field(default_factory=lambda: PlcProgram(first_sequence=100, epoch=7))
    status: StatusBits = READY
    block: tuple[int, ...] = NOTHING
    fault_code: int = 0
    heartbeat_stands: bool = False
    now_s: float = 0.0
    _heartbeat: int = 0

    def scan(self, times: int = 1) -> PlcRequest:
        for _ in range(times):
            if self.program.wants_part:
                self.program.load(f"SN-{self.program.index}")
            self.now_s += 0.05
            self._heartbeat += not self.heartbeat_stands
            image = StationImage(
                status=self.status,
                heartbeat=self._heartbeat & 0xFFFF,
                epoch=1,
                fault_code=self.fault_code,
                block=self.block,
            )
            out = self.program.scan(image, self.now_s)
        return out

    def events(self) -> list[str]:
        return [line["event"] for line in self.program.log]


def asked() -> tuple[Nest, PlcRequest]:
    nest = Nest()
    request = nest.scan()
    assert request.has(Ctrl.ENABLE | Ctrl.PART_PRESENT | Ctrl.START)
    return nest, request


def test_it_asks_with_the_next_sequence_the_serial_and_a_crc() -> None:
    _, request = asked()
    assert (request.sequence, request.serial, request.recipe) == (101, "SN-0", 1)
    assert not request.has(Ctrl.PART_CHANGED)
    assert decode_request(encode_request(request)).crc_ok(accept_zero=False)


def test_a_whole_part_from_request_to_the_next() -> None:
    nest, request = asked()
    nest.status = BUSY
    assert nest.scan(100).has(Ctrl.START)
    nest.status, nest.block = VALID, verdict(request).encode()
    routed = nest.scan()
    assert routed.has(Ctrl.RESULT_ACK)
    assert not routed.has(Ctrl.START)
    assert (routed.ack_sequence, routed.ack_code) == (101, 1)
    assert nest.program.log[-1] | {"time_ms": 0} == {
        "event": "verdict",
        "index": 0,
        "serial": "SN-0",
        "sequence": 101,
        "verdict": "REPAIR",
        "code": 2,
        "reason": 0,
        "record_id": 1,
        "worst_deviation_um": 0,
        "missing_volume_mm3": 0.0,
        "defects": 0,
        "coverage_percent": 0.0,
        "time_ms": 0,
        "station_epoch": 1,
    }
    assert nest.scan(100).has(Ctrl.RESULT_ACK)
    nest.status, nest.block = StatusBits.ONLINE, NOTHING
    unloaded = nest.scan()
    assert not unloaded.ctrl & (Ctrl.RESULT_ACK | Ctrl.PART_PRESENT)
    nest.status = READY
    again = nest.scan(2)
    assert (again.sequence, again.serial, again.has(Ctrl.START)) == (102, "SN-1", True)


@pytest.mark.parametrize("at", [2, 3, 8, 12, 20, 28, 34, 35])
def test_a_block_that_fails_a_check_is_read_again_then_refused(at: int) -> None:
    nest, request = asked()
    block = list(verdict(request).encode())
    block[at] ^= 0x0101
    nest.status, nest.block = VALID, tuple(block)
    assert nest.scan(2).ack_code == 0
    refused = nest.scan()
    assert (refused.ack_code, refused.has(Ctrl.RESULT_ACK)) == (2, True)
    assert nest.events() == ["rejected"]


def test_a_torn_block_that_heals_is_taken() -> None:
    nest, request = asked()
    nest.status, nest.block = VALID, NOTHING[:1] + verdict(request).encode()[1:-1] + (0,)
    nest.scan(2)
    nest.block = verdict(request).encode()
    assert nest.scan().ack_code == 1


@pytest.mark.parametrize("change", [{"serial": "SN-9"}, {"sequence": 100}, {"sequence": 2**31}])
def test_i4_a_verdict_for_another_request_is_never_routed(change: dict[str, object]) -> None:
    nest, request = asked()
    nest.status, nest.block = VALID, verdict(request, **change).encode()
    assert nest.scan(3).ack_code == 2
    assert "verdict" not in nest.events()


def test_a_part_changed_meanwhile_is_not_routed_with_its_verdict() -> None:
    nest, request = asked()
    nest.program.part_changed = True
    nest.status, nest.block = VALID, verdict(request).encode()
    assert nest.scan().ack_code == 2
    assert nest.events() == ["rejected"]
    nest.status, nest.block = READY, NOTHING
    again = nest.scan(2)
    assert (again.sequence, again.serial, again.has(Ctrl.START)) == (102, "SN-0", True)


def test_after_a_start_a_verdict_that_stands_is_sent_back() -> None:
    """The latch counts as set: whose part lies there is not known."""
    nest = Nest(status=VALID, block=verdict(PlcRequest(sequence=100, serial="SN-0")).encode())
    out = nest.scan()
    assert (out.ack_code, out.ack_sequence, out.has(Ctrl.PART_CHANGED)) == (2, 100, True)
    assert nest.events() == []


def test_a_station_whose_heart_stands_still_is_not_believed() -> None:
    nest, request = asked()
    nest.heartbeat_stands = True
    nest.scan(41)
    nest.status, nest.block = VALID, verdict(request).encode()
    assert nest.scan(10).ack_code == 0
    nest.heartbeat_stands = False
    assert nest.scan().ack_code == 1


@pytest.mark.parametrize(
    ("code", "status"), [(2, StatusBits.ONLINE), (0, StatusBits.ONLINE | StatusBits.ABORTED)]
)
def test_a_refused_request_is_made_anew_with_another_sequence(code: int, status: StatusBits) -> None:
    nest, _ = asked()
    nest.status, nest.fault_code = status, code
    assert not nest.scan().has(Ctrl.START)
    assert nest.events() == ["refused"]
    nest.status, nest.fault_code = READY, 0
    assert not nest.scan(10).has(Ctrl.START)
    again = nest.scan(20)
    assert (again.sequence, again.serial, again.has(Ctrl.START)) == (102, "SN-0", True)


def test_a_request_that_nobody_answers_is_given_up() -> None:
    nest, _ = asked()
    nest.status = StatusBits.ONLINE
    assert nest.scan(200).has(Ctrl.START)
    assert not nest.scan(60).has(Ctrl.START)
    assert nest.events() == ["unanswered"]


def test_faults_are_reset_by_an_edge_again_and_again() -> None:
    nest = Nest(status=StatusBits.ONLINE | StatusBits.FAULT)
    presses = [nest.scan().has(Ctrl.RESET_FAULT) for _ in range(300)]
    edges = sum(b and not a for a, b in pairwise(presses))
    assert edges == 3
    nest.status = READY
    assert not nest.scan(2).has(Ctrl.RESET_FAULT)


def test_the_heartbeat_counts_every_half_second_and_echoes() -> None:
    nest = Nest()
    first = nest.scan().heartbeat
    last = nest.scan(100)
    assert last.heartbeat - first in (9, 10)
    assert last.echo_station_heartbeat == 101
    assert last.epoch == 7


def test_it_stops_after_its_parts() -> None:
    nest = Nest(program=PlcProgram(first_sequence=1, epoch=1, parts=1))
    request = nest.scan()
    nest.status, nest.block = VALID, verdict(request).encode()
    nest.scan()
    nest.status, nest.block = READY, NOTHING
    out = nest.scan(100)
    assert nest.program.phase is Phase.DONE
    assert out.ctrl == Ctrl.ENABLE | Ctrl.PART_CHANGED
    assert not nest.program.wants_part


def test_without_a_station_it_only_beats() -> None:
    program = PlcProgram(first_sequence=1, epoch=1)
    program.load("SN-0")
    assert [program.scan(None, now_s / 2).ctrl for now_s in range(5)] == [
        Ctrl.ENABLE | Ctrl.PART_PRESENT | Ctrl.PART_CHANGED
    ] * 5


def test_an_image_of_another_size_is_a_bad_reply() -> None:
    with pytest.raises(BadReply):
        decode_image([0] * 39)


class StrangeStation(RuleBasedStateMachine):
    """A station that shows anything in any order; the PLC routes a part once, with its own verdict or not."""

    @initialize()
    def start(self) -> None:
        self.nest = Nest()
        self.requests: dict[int, str] = {}
        self.true: dict[int, VerdictCode] = {}

    @rule(times=st.integers(1, 40))
    def wait(self, times: int) -> None:
        for _ in range(times):
            out = self.nest.scan()
            if out.has(Ctrl.START) and out.serial is not None:
                self.requests.setdefault(out.sequence, out.serial)

    @rule(bits=st.integers(0, 0x1FFF))
    def show(self, bits: int) -> None:
        self.nest.status = StatusBits(bits)

    @rule()
    def be_ready(self) -> None:
        self.nest.status, self.nest.block, self.nest.fault_code = READY, NOTHING, 0

    @precondition(lambda self: self.requests)
    @rule(which=st.integers(0, 5), code=st.sampled_from([1, 2, 3, 4]))
    def publish(self, which: int, code: int) -> None:
        sequence = sorted(self.requests)[-1 - which % len(self.requests)]
        told = self.true.setdefault(sequence, VerdictCode(code))
        request = PlcRequest(sequence=sequence, serial=self.requests[sequence])
        self.nest.status, self.nest.block = VALID, verdict(request, verdict=told).encode()

    @rule(at=st.integers(0, 35), bit=st.integers(0, 15))
    def flip(self, at: int, bit: int) -> None:
        block = list(self.nest.block)
        block[at] ^= 1 << bit
        self.nest.block = tuple(block)

    @rule(code=st.integers(0, 5), stands=st.booleans())
    def upset(self, code: int, stands: bool) -> None:
        self.nest.fault_code, self.nest.heartbeat_stands = code, stands

    @rule()
    def swap(self) -> None:
        self.nest.program.part_changed = True

    @invariant()
    def routes_each_part_once_and_rightly(self) -> None:
        routed = [line for line in self.nest.program.log if line["event"] == "verdict"]
        assert len({line["index"] for line in routed}) == len(routed)
        for line in routed:
            assert self.requests[line["sequence"]] == line["serial"]
            assert VerdictCode[line["verdict"]] == self.true[line["sequence"]]


TestStrangeStation = StrangeStation.TestCase
TestStrangeStation.settings = settings(max_examples=40, stateful_step_count=30, deadline=None)


async def serve_parts(link: PlcLink, judge: Callable[[PlcRequest], VerdictCode]) -> None:
    """A station that knows the four phases and nothing else."""
    clock = asyncio.get_running_loop().time

    async def until(holds: Callable[[PlcRequest], bool]) -> PlcRequest:
        while not holds(link.request()):
            link.beat(clock())
            await asyncio.sleep(0.01)
        return link.request()

    while True:
        link.set_status(READY)
        request = await until(lambda r: r.has(Ctrl.START))
        link.set_status(BUSY)
        link.publish(verdict(request, verdict=judge(request)), VALID)
        sequence = request.sequence
        await until(lambda r, wanted=sequence: r.has(Ctrl.RESULT_ACK) and r.ack_sequence == wanted)
        link.clear_result()
        link.set_status(StatusBits.ONLINE)
        await until(lambda r: not r.ctrl & (Ctrl.START | Ctrl.RESULT_ACK))


async def test_on_the_wire_it_routes_part_after_part_across_a_restart_of_the_station() -> None:
    lines: list[Line] = []
    verdicts = {"SN-0": VerdictCode.PASS, "SN-1": VerdictCode.SCRAP, "SN-2": VerdictCode.HOLD}

    async def load(index: int) -> str:
        return f"SN-{index}"

    async def serve(port: int, until: int) -> int:
        async with PlcLink.open("127.0.0.1", port, epoch=until) as link:
            serving = asyncio.ensure_future(serve_parts(link, lambda r: verdicts[r.serial or ""]))
            while len(lines) < until:
                await asyncio.sleep(0.01)
                assert not serving.done()
            serving.cancel()
            return link.port

    async with asyncio.timeout(20.0):
        async with PlcLink.open("127.0.0.1", 0) as link:
            port = link.port
        program = PlcProgram(first_sequence=10, epoch=1, parts=3)
        plc = asyncio.ensure_future(run_plc(program, "127.0.0.1", port, load=load, report=lines.append))
        await serve(port, 1)
        await serve(port, 3)
        plc.cancel()
    assert [(line["serial"], line["verdict"]) for line in lines if line["event"] == "verdict"] == [
        (serial, code.name) for serial, code in verdicts.items()
    ]


async def test_it_ends_when_told_even_while_it_connects_in_vain() -> None:
    async def load(_index: int) -> str:
        return "SN-0"

    for pause_s in (0.0, 0.001, 0.002, 0.05, 0.051, 0.052):
        program = PlcProgram(first_sequence=10, epoch=1)
        plc = asyncio.ensure_future(run_plc(program, "127.0.0.1", 1, load=load, report=lambda _: None))
        await asyncio.sleep(pause_s)
        plc.cancel()
        done, _ = await asyncio.wait({plc}, timeout=5.0)
        assert done


async def test_a_swallowed_cancellation_still_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    async def read(_client: object) -> None:
        with suppress(asyncio.CancelledError):
            await asyncio.sleep(60.0)

    async def load(_index: int) -> str:
        return "SN-0"

    monkeypatch.setattr("simulators.plc._read", read)
    program = PlcProgram(first_sequence=10, epoch=1)
    plc = asyncio.ensure_future(run_plc(program, "127.0.0.1", 1, load=load, report=lambda _: None))
    await asyncio.sleep(0)
    plc.cancel()
    done, _ = await asyncio.wait({plc}, timeout=5.0)
    assert done


async def test_on_the_wire_a_refusal_is_answered_with_a_new_sequence() -> None:
    lines: list[Line] = []

    async def load(_index: int) -> str:
        return "SN-0"

    async with asyncio.timeout(10.0), PlcLink.open("127.0.0.1", 0) as link:
        program = PlcProgram(first_sequence=10, epoch=1)
        plc = asyncio.ensure_future(run_plc(program, "127.0.0.1", link.port, load=load, report=lines.append))
        clock = asyncio.get_running_loop().time
        link.set_status(READY)
        sequences = set()
        while len(sequences) < 2:
            link.beat(clock())
            request = link.request()
            if request.has(Ctrl.START):
                sequences.add(request.sequence)
                link.refuse(FaultCode.NEW_SEQUENCE_NEEDED, 0, StatusBits.ONLINE)
            else:
                link.clear_result()
                link.set_status(READY)
            await asyncio.sleep(0.01)
        plc.cancel()
    assert sequences == {11, 12}
    assert lines[0]["event"] == "refused"
