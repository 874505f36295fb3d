"""The handshake in virtual time: each sentence of the contract, then random interleavings with crashes.

`Bench` does what the handshake asks for, as the station does: the record first, then the registers.
"""

import random
from dataclasses import dataclass, field, replace

import pytest

from drivers.wire.plc import Ctrl, FaultCode, PlcRequest, StatusBits, decode_request, encode_request
from station import handshake as shaking
from station.handshake import (
    Accept,
    Acked,
    AckLate,
    Handshake,
    Health,
    Interrupt,
    Phase,
    Refuse,
    Released,
    ResetEdge,
    Seen,
    Unrefuse,
)

READY, START_ACK, BUSY = StatusBits.READY, StatusBits.START_ACK, StatusBits.BUSY
VALID, FAULT, ABORTED = StatusBits.RESULT_VALID, StatusBits.FAULT, StatusBits.ABORTED
UP = Ctrl.ENABLE | Ctrl.PART_PRESENT


def asking(sequence: int = 7, serial: str = "SN-1", **fields: object) -> PlcRequest:
    """A request with START up and the right CRC."""
    request = PlcRequest(sequence=sequence, serial=serial, recipe=1, epoch=3, ctrl=UP | Ctrl.START)
    return decode_request(encode_request(replace(request, **fields)))  # type: ignore[arg-type]


@dataclass
class Row:
    """One line of the record."""

    serial: str
    state: str = "ACCEPTED"
    verdict: str = ""


@dataclass
class Bench:
    """A station around the handshake. `journal` survives a restart, nothing else does."""

    journal: dict[int, Row] = field(default_factory=dict)
    shake: Handshake = field(default_factory=Handshake)
    request: PlcRequest = field(default_factory=lambda: PlcRequest(ctrl=UP, epoch=3))
    alive: bool = True
    ready: bool = True
    now_s: float = 0.0
    block: tuple[int, str, str] | None = None
    fault_code: FaultCode = FaultCode.NONE
    log: list[object] = field(default_factory=list)
    accept_zero: bool = True

    def tick(self, request: PlcRequest | None = None, dt_s: float = 0.05) -> StatusBits:
        """One look, with the disk as fast as the loop."""
        self.request = request or self.request
        self.now_s += dt_s
        self.shake, actions = shaking.step(self.shake, self.seen())
        for action in actions:
            self.log.append(action)
            self.perform(action)
        return self.status()

    def seen(self) -> Seen:
        past = self.journal.get(self.request.sequence)
        return Seen(
            request=self.request,
            plc_alive=self.alive,
            ready=self.ready,
            recipe_known=self.request.recipe == 1,
            past_serial=past.serial if past else None,
            accept_crc_zero=self.accept_zero,
            now_s=self.now_s,
        )

    def perform(self, action: object) -> None:
        match action:
            case Accept(request=request):
                self.journal[request.sequence] = Row(request.serial or "")
                self.block = None
                self.shake = shaking.accepted(self.shake)
                self.tick(dt_s=0.0)
            case Refuse(code=code):
                self.fault_code = code
            case Unrefuse():
                self.fault_code = FaultCode.NONE
            case Interrupt():
                self.journal[self.shake.sequence].state = "INTERRUPTED"
                self.shake = shaking.closed(self.shake)
            case Acked(code=code):
                self.journal[self.shake.sequence].state = f"ACKED {code}"
                self.shake = shaking.acked(self.shake)
                self.block = None

    def decide(self, verdict: str = "PASS") -> StatusBits:
        """The end of a measurement: record, then registers."""
        row = self.journal[self.shake.sequence]
        row.state, row.verdict = "PUBLISHED", verdict
        return self.publish(self.shake.sequence)

    def publish(self, sequence: int) -> StatusBits:
        row = self.journal[sequence]
        self.block = (sequence, row.serial, row.verdict)
        self.shake = shaking.published(self.shake, sequence, row.serial, self.now_s)
        return self.status()

    def restart(self) -> None:
        """The station is killed and starts again: what was in hand is interrupted, what stands stands."""
        self.shake, self.block, self.fault_code = Handshake(), None, FaultCode.NONE
        self.request = PlcRequest()
        for row in self.journal.values():
            row.state = "INTERRUPTED" if row.state == "ACCEPTED" else row.state
        standing = [sequence for sequence, row in self.journal.items() if row.state == "PUBLISHED"]
        assert len(standing) <= 1
        for sequence in standing:
            self.publish(sequence)

    def status(self) -> StatusBits:
        health = Health(
            ready=self.ready,
            faulted=False,
            moving=False,
            plc_alive=self.alive,
            manual=False,
            safe_to_unload=True,
            calibration_due=False,
        )
        return shaking.status(self.shake, self.request, health)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def measuring(bench: Bench, request: PlcRequest | None = None) -> Bench:
    bench.tick(request or asking())
    assert bench.shake.phase is Phase.MEASURING
    return bench


def acknowledging(sequence: int = 7, code: int = 1, start: bool = False) -> PlcRequest:
    ctrl = UP | Ctrl.RESULT_ACK | (Ctrl.START if start else Ctrl(0))
    return asking(sequence, ctrl=ctrl, ack_sequence=sequence, ack_code=code)


def test_the_whole_walk(bench: Bench) -> None:
    assert bench.tick() & (READY | START_ACK | BUSY | VALID) == READY
    assert bench.tick(asking()) & (READY | START_ACK | BUSY | VALID) == START_ACK | BUSY
    assert bench.block is None
    assert bench.decide() & (READY | START_ACK | BUSY | VALID) == START_ACK | VALID
    assert bench.tick(acknowledging(start=True)) & (READY | START_ACK | BUSY | VALID) == StatusBits(0)
    assert bench.tick(acknowledging()) & READY == StatusBits(0)
    assert bench.tick(asking(ctrl=UP)) & (READY | START_ACK | BUSY | VALID) == READY
    assert bench.journal[7].state == "ACKED 1"


def test_the_fall_of_start_never_aborts(bench: Bench) -> None:
    measuring(bench)
    assert bench.tick(asking(ctrl=UP)) & (START_ACK | BUSY) == START_ACK | BUSY
    assert bench.decide() & VALID


def test_start_up_until_the_ack(bench: Bench) -> None:
    measuring(bench).decide()
    assert bench.tick(asking()) & VALID
    assert not bench.tick(acknowledging(start=True)) & VALID
    assert not bench.tick(asking(ctrl=UP | Ctrl.START)) & READY
    assert bench.tick(asking(ctrl=UP)) & READY


def test_an_ack_for_another_sequence_changes_nothing(bench: Bench) -> None:
    measuring(bench).decide()
    before = bench.block, bench.shake.phase
    assert bench.tick(asking(ctrl=UP | Ctrl.RESULT_ACK, ack_sequence=6, ack_code=1)) & VALID
    assert (bench.block, bench.shake.phase) == before


@pytest.mark.parametrize(
    ("change", "alarm"),
    [
        ({"ctrl": Ctrl.ENABLE | Ctrl.START}, 206),
        ({"ctrl": UP | Ctrl.START | Ctrl.ABORT}, 214),
        ({"ctrl": Ctrl.PART_PRESENT | Ctrl.START}, 214),
        ({"ctrl": UP | Ctrl.START | Ctrl.PART_CHANGED}, 131),
        ({"epoch": 4}, 121),
    ],
)
def test_broken_continuity_ends_without_a_verdict(
    bench: Bench, change: dict[str, object], alarm: int
) -> None:
    measuring(bench)
    status = bench.tick(asking(**change))  # type: ignore[arg-type]
    assert status & (START_ACK | BUSY | VALID | ABORTED) == ABORTED
    assert bench.block is None
    interruptions = [action.alarm for action in bench.log if isinstance(action, Interrupt)]
    assert interruptions == [alarm]
    assert bench.journal[7].state == "INTERRUPTED"
    assert not bench.tick(asking(**{**change, "ctrl": UP | Ctrl.START})) & READY  # type: ignore[arg-type]
    assert bench.tick(asking(ctrl=UP)) & READY


def test_a_part_changed_latch_that_stood_before_is_the_plcs_own_affair(bench: Bench) -> None:
    ctrl = UP | Ctrl.START | Ctrl.PART_CHANGED
    measuring(bench, asking(ctrl=ctrl))
    assert bench.tick(asking(ctrl=ctrl)) & BUSY


def test_a_lost_plc_interrupts_a_measurement_and_keeps_a_verdict(bench: Bench) -> None:
    measuring(bench)
    bench.alive = False
    assert bench.tick() & (BUSY | ABORTED) == ABORTED
    bench = Bench()
    measuring(bench).decide()
    bench.alive = False
    for _ in range(100):
        assert bench.tick(dt_s=1.0) & VALID
    assert bench.status() & StatusBits.PLC_LOST
    assert bench.block == (7, "SN-1", "PASS")


def test_no_part_at_the_start_is_never_busy(bench: Bench) -> None:
    status = bench.tick(asking(ctrl=Ctrl.ENABLE | Ctrl.START))
    assert status & (START_ACK | BUSY | READY) == StatusBits(0)
    assert bench.journal[7].state == "INTERRUPTED"


def refusal(bench: Bench) -> FaultCode:
    status = bench.status()
    assert status & (READY | START_ACK | BUSY | VALID | FAULT) == StatusBits(0)
    return bench.fault_code


def test_a_bad_crc_is_refused_until_start_falls(bench: Bench) -> None:
    bench.tick(replace(asking(), crc=1))
    assert refusal(bench) is FaultCode.BAD_CRC
    bench.tick(asking())
    assert refusal(bench) is FaultCode.BAD_CRC  # not served behind its back
    bench.tick(asking(ctrl=UP))
    assert bench.fault_code is FaultCode.NONE
    assert bench.tick(asking()) & BUSY


def test_crc_zero_counts_only_where_the_configuration_says_so(bench: Bench) -> None:
    bench.accept_zero = False
    bench.tick(replace(asking(), crc=0))
    assert refusal(bench) is FaultCode.BAD_CRC
    other = Bench()
    assert other.tick(replace(asking(), crc=0)) & BUSY


def test_an_unknown_recipe_is_refused(bench: Bench) -> None:
    bench.tick(asking(recipe=9))
    assert refusal(bench) is FaultCode.UNKNOWN_RECIPE


def test_an_unreadable_serial_is_refused(bench: Bench) -> None:
    bench.tick(replace(asking(), serial=None))
    assert refusal(bench) is FaultCode.NEW_SEQUENCE_NEEDED
    assert bench.journal == {}


def test_a_duplicate_of_an_acknowledged_request_is_refused_and_not_scanned(bench: Bench) -> None:
    measuring(bench).decide()
    bench.tick(acknowledging())
    bench.tick(asking(ctrl=UP))
    bench.tick(asking())
    assert refusal(bench) is FaultCode.NEW_SEQUENCE_NEEDED
    bench.tick(asking(ctrl=UP))
    bench.tick(asking(serial="SN-2"))
    assert refusal(bench) is FaultCode.SEQUENCE_REUSED
    assert bench.status() & StatusBits.SEQ_REUSED
    assert sum(isinstance(action, Accept) for action in bench.log) == 1


def test_a_duplicate_while_published_leaves_the_result(bench: Bench) -> None:
    measuring(bench).decide("REPAIR")
    bench.tick(asking(ctrl=UP))
    assert bench.tick(asking()) & (START_ACK | BUSY | VALID) == START_ACK | VALID
    assert bench.tick(asking(serial="SN-2")) & StatusBits.SEQ_REUSED
    assert bench.tick(asking(sequence=8)) & VALID
    assert bench.block == (7, "SN-1", "REPAIR")


def test_a_start_while_busy_is_ignored(bench: Bench) -> None:
    measuring(bench)
    assert bench.tick(asking(sequence=8, serial="SN-2")) & (START_ACK | BUSY) == START_ACK | BUSY
    bench.decide()
    assert bench.block == (7, "SN-1", "PASS")
    assert list(bench.journal) == [7]


def test_sequences_may_start_anywhere(bench: Bench) -> None:
    for sequence in (2**31 - 1, 0, 5):
        bench.tick(asking(sequence))
        bench.decide()
        bench.tick(acknowledging(sequence))
        assert bench.tick(asking(sequence, ctrl=UP)) & READY
    assert set(bench.journal) == {2**31 - 1, 0, 5}


def test_a_late_ack_raises_one_alarm_and_stays_welcome(bench: Bench) -> None:
    measuring(bench).decide()
    for _ in range(200):
        bench.tick(dt_s=1.0)
    assert sum(isinstance(action, AckLate) for action in bench.log) == 1
    assert not bench.tick(acknowledging(code=2)) & VALID
    assert bench.journal[7].state == "ACKED 2"


def test_reset_is_an_edge_and_never_a_level() -> None:
    bench = Bench(alive=False)
    held = asking(ctrl=UP | Ctrl.RESET_FAULT)
    for alive in (False, True, True):
        bench.alive = alive
        bench.tick(held)
    assert not any(isinstance(action, ResetEdge) for action in bench.log)
    bench.tick(asking(ctrl=UP))
    for _ in range(5):
        bench.tick(held)
    assert sum(isinstance(action, ResetEdge) for action in bench.log) == 1


def test_released_is_told_once(bench: Bench) -> None:
    measuring(bench).decide()
    bench.tick(acknowledging())
    bench.tick(asking(ctrl=UP))
    bench.tick(asking(ctrl=UP))
    assert sum(isinstance(action, Released) for action in bench.log) == 1


def test_a_station_that_is_not_ready_lets_a_request_wait(bench: Bench) -> None:
    bench.ready = False
    assert not bench.tick(asking()) & (START_ACK | READY)
    bench.ready = True
    assert bench.tick() & BUSY


def test_after_a_restart_a_published_verdict_stands_again_and_a_standing_ack_counts(bench: Bench) -> None:
    measuring(bench).decide("SCRAP")
    block = bench.block
    bench.restart()
    assert bench.status() & (START_ACK | BUSY | VALID) == START_ACK | VALID
    assert bench.block == block
    assert not bench.tick(acknowledging(start=True)) & VALID
    assert bench.journal[7].state == "ACKED 1"


def test_after_a_restart_an_interrupted_sequence_needs_a_new_one(bench: Bench) -> None:
    measuring(bench)
    bench.restart()
    bench.tick(asking())
    assert refusal(bench) is FaultCode.NEW_SEQUENCE_NEEDED
    bench.tick(asking(ctrl=UP))
    assert bench.tick(asking(8)) & BUSY


def test_a_station_that_gives_up_lets_go_of_the_request_but_not_of_a_verdict() -> None:
    held = Handshake(phase=Phase.MEASURING, sequence=7)
    assert shaking.broken_off(held).phase is Phase.STOPPING
    assert shaking.closed(shaking.broken_off(held)).phase is Phase.ABORTED
    standing = Handshake(phase=Phase.PUBLISHED, sequence=7)
    assert shaking.closed(shaking.broken_off(standing)) == standing


class Nest:
    """One place for a part; every serial comes twice, each time in another condition."""

    def __init__(self, chance: random.Random) -> None:
        self.chance = chance
        self.number = 0
        self.part: int | None = None
        self.truth: dict[int, str] = {}
        self.routed: list[tuple[int, str]] = []

    def load(self) -> None:
        self.number += 1
        self.part = self.number
        self.truth[self.number] = self.chance.choice(("PASS", "REPAIR", "SCRAP"))

    @property
    def serial(self) -> str | None:
        return None if self.part is None else f"SN-{(self.part + 1) // 2}"


class Plc:
    """A PLC that obeys docs/wire/plc.md; `kept` is its retentive memory."""

    def __init__(self, nest: Nest) -> None:
        self.nest = nest
        self.kept = {"sequence": 0, "done": 0, "serial": ""}
        self.epoch = 0
        self.boot()

    def boot(self) -> None:
        self.epoch += 1
        self.changed = True  # after its own start nobody knows what happened in the nest
        self.start = self.ack = False
        self.ack_sequence = self.ack_code = 0
        self.phase = "INIT"

    def image(self) -> PlcRequest:
        bits = {
            Ctrl.ENABLE: True,
            Ctrl.PART_PRESENT: self.nest.part is not None,
            Ctrl.START: self.start,
            Ctrl.RESULT_ACK: self.ack,
            Ctrl.PART_CHANGED: self.changed,
        }
        ctrl = Ctrl(0)
        for bit, up in bits.items():
            ctrl |= bit if up else Ctrl(0)
        return asking(
            int(self.kept["sequence"]),
            str(self.kept["serial"]) or "NONE",
            ctrl=ctrl,
            epoch=self.epoch,
            ack_sequence=self.ack_sequence,
            ack_code=self.ack_code,
        )

    def step(self, status: StatusBits, block: tuple[int, str, str] | None) -> None:
        match self.phase:
            case "INIT":
                self.start = self.ack = False
                if status & VALID and block is not None:
                    self.answer(block)
                elif not status & BUSY:
                    self.phase = "IDLE"
            case "IDLE" if status & VALID:
                self.phase = "INIT"
            case "IDLE" if self.nest.part is None:
                self.nest.load()
            case "IDLE" if status & READY:
                self.kept["sequence"] = int(self.kept["sequence"]) + 1
                self.kept["serial"], self.changed = self.nest.serial or "", False
                self.start, self.phase, self.waited = True, "WAIT", 0
            case "WAIT":
                self.waited += 1
                if status & VALID and block is not None:
                    self.answer(block)
                elif self.waited > 40:
                    self.phase = "INIT"
            case "CLEAR" if not status & VALID or block is None or block[0] != self.ack_sequence:
                self.ack, self.phase = False, "IDLE"

    def answer(self, block: tuple[int, str, str]) -> None:
        sequence, serial, verdict = block
        mine = sequence == self.kept["sequence"] and int(self.kept["done"]) < sequence
        same = serial == self.nest.serial == self.kept["serial"] and not self.changed
        self.ack_code = 2
        if mine and same and verdict != "HOLD":
            self.kept["done"] = sequence
            assert self.nest.part is not None
            self.nest.routed.append((self.nest.part, verdict))
            self.nest.part, self.ack_code = None, 1
        self.start, self.ack, self.ack_sequence, self.phase = False, True, sequence, "CLEAR"


def play(seed: int, steps: int = 1200, latch: bool = True) -> tuple[int, int]:
    """Parts routed and crashes, after random interleavings with delayed sight, crashes and swapped parts."""
    chance = random.Random(seed)
    nest = Nest(chance)
    plc, bench = Plc(nest), Bench()
    bench.request = plc.image()
    status, block, measured, left, crashes = bench.status(), bench.block, None, 0, 0
    for _ in range(steps):
        dice = chance.random()
        if dice < 0.42:
            bench.tick()
            if bench.shake.phase is not Phase.MEASURING:
                measured = None
            elif measured is None:
                # What lies in the nest when the scan begins is what is measured.
                measured, left = nest.part, 3
            elif (left := left - 1) == 0:
                fits = nest.part == measured and nest.serial == bench.journal[bench.shake.sequence].serial
                bench.decide(nest.truth[measured] if fits else "HOLD")
        elif dice < 0.84:
            plc.step(status, block)
        elif dice < 0.90:
            status, block = bench.status(), bench.block
        elif dice < 0.96:
            bench.request = plc.image()
        elif dice < 0.965:
            bench.restart()
            measured, crashes = None, crashes + 1
        elif dice < 0.97:
            plc.boot()
            crashes += 1
        elif dice < 0.975 and nest.part is not None:
            nest.load()
            plc.changed = latch
        plc.changed &= latch
    parts = [part for part, _ in nest.routed]
    assert len(parts) == len(set(parts)), f"seed {seed}: routed twice"
    wrong = [(part, word) for part, word in nest.routed if nest.truth[part] != word]
    assert not wrong, f"seed {seed}: {wrong}"
    return len(parts), crashes


def test_no_part_is_routed_twice_or_by_another_parts_verdict() -> None:
    """The random-interleaving check of the handshake: delayed images, crashes of both sides, swaps."""
    routed = crashes = 0
    for seed in range(40):
        parts, fell = play(seed)
        routed, crashes = routed + parts, crashes + fell
    assert routed > 200
    assert crashes > 200


def test_the_check_has_teeth() -> None:
    """Without the PLC's latch of a changed nest the same check finds parts routed by another's verdict."""
    caught = 0
    for seed in range(40):
        try:
            play(seed, latch=False)
        except AssertionError:
            caught += 1
    assert caught > 0
