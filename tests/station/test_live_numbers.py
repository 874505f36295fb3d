"""What the PLC is told beside the word: reasons and figures, against docs/wire/plc.md and hand-made parts."""

import importlib.util
import re
from datetime import UTC, datetime
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from drivers.errors import BadReply, DeviceFault, LinkDown, Refused, Timeout
from drivers.wire.plc import VerdictCode, decode_result
from geometry.types import Zone
from station.alarms import KINDS
from station.chain import RecordBroken, RecordFailed
from station.gates import Gate, Gates
from station.job import decided, finding_row
from station.numbers import differences, numbers
from station.plans import SECTION_KEYS, BladeLimits
from station.proof import Figures, unproven
from station.publish import figures, result_block
from station.reasons import (
    BLADE,
    DAMAGE,
    FORM,
    OTHER_OF_SECTION,
    SECTION,
    SIZE,
    Unfit,
    alarm_number,
    characteristic_number,
    ends_only_the_part,
    reason_number,
)
from station.record import CommittedVerdict, Ticket
from station.verdict import judge
from station.worker import WorkerDied, WorkerTimeout

ROOT = Path(__file__).parents[2]


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, Path(__file__).parent / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


parts, workload = load("parts"), load("record_workload")
NOW = datetime(2026, 1, 1, tzinfo=UTC)


def test_the_manual_tables_every_number() -> None:
    page = (ROOT / "docs" / "wire" / "plc.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| (\d+) \| (.*?) \|", page[page.index("## REASON") :], re.MULTILINE))
    sizes = {zone + size for zone in DAMAGE.values() for size in SIZE.values()}
    others = {OTHER_OF_SECTION, FORM, BLADE}
    assert {int(number) for number in rows} == set(KINDS) | set(SECTION.values()) | others | sizes
    assert all(rows[str(number)] == kind.text for number, kind in KINDS.items())


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("sections[52.5].chord_mm", 404),
        ("sections[-7.0].position_mm", 401),
        ("form.deviation_mm", 410),
        ("damage.tip.depth_mm", 421),
        ("damage.surface.count", 453),
    ],
)
def test_characteristics_have_numbers(name: str, number: int) -> None:
    assert characteristic_number(name) == number


def test_whatever_a_plan_can_limit_has_a_number() -> None:
    keys = {*SECTION_KEYS, "le_thickness_at_2_mm"}
    assert all(characteristic_number(f"sections[7.0].{key}") in range(401, 410) for key in keys)
    assert {characteristic_number(f"blade.{key}") for key in BladeLimits.model_fields} == {BLADE}


SCRAPPED = {"damages": (parts.damage(zone=Zone.SURFACE, depth=6.0),)}
REPAIRED = {"damages": (parts.damage(depth=8.0),), "repairs": parts.repairs(parts.patch())}
OPEN = Gate(holds=False, reason="open")


@pytest.mark.parametrize(
    ("found", "gates", "word", "reason"),
    [
        ({}, parts.GATES, "PASS", 0),
        (REPAIRED, parts.GATES, "REPAIR", 421),
        (SCRAPPED, parts.GATES, "SCRAP", 451),
        ({"sections": (parts.section(chord_mm=47.0),)}, parts.GATES, "SCRAP", 404),
        ({"alignment": None, "failures": {"register": "no pose"}}, parts.GATES, "HOLD", 209),
        ({"zones": (parts.coverage(Zone.TIP, 0.5),)}, parts.GATES, "HOLD", 204),
        ({"sections": ()}, parts.GATES, "HOLD", 210),
        ({**REPAIRED, "repairs": parts.repairs()}, parts.GATES, "HOLD", 211),
        ({"sections": (parts.section(chord_mm=45.25),)}, parts.GATES, "HOLD", 212),
        (
            {},
            Gates(calibration=OPEN, daily_check=parts.CLOSED, continuity=parts.CLOSED, mode=parts.CLOSED),
            "HOLD",
            134,
        ),
        (
            {},
            Gates(calibration=parts.CLOSED, daily_check=parts.CLOSED, continuity=OPEN, mode=parts.CLOSED),
            "HOLD",
            133,
        ),
    ],
)
def test_every_verdict_has_its_reason_and_proves_itself(
    found: dict[str, object], gates: Gates, word: str, reason: int
) -> None:
    measurement = parts.measurement(**found)
    verdict = judge(measurement, parts.plan(), gates)
    assert (verdict.verdict.value, reason_number(verdict, gates)) == (word, reason)
    decision = decided(measurement, parts.plan(), verdict, gates, None, {}, NOW)
    assert unproven(decision) is None
    if word != "PASS":
        assert decision.reasons
        wrong = decided(measurement, parts.plan(), verdict, gates, None, {}, NOW).body() | {"verdict": "PASS"}
        assert unproven(type(decision).from_body(wrong)) is not None


@pytest.mark.parametrize(
    ("error", "number"),
    [
        (LinkDown("turntable", "p", "gone"), 101),
        (Timeout("turntable", "p", "silent"), 101),
        (DeviceFault("turntable", "p", "stalled and stopped (FS)"), 102),
        (DeviceFault("turntable", "p", "lost its reference (WR): it was restarted"), 103),
        (DeviceFault("turntable", "p", "moved from 1 to 2 deg while the scanner exposed"), 103),
        (LinkDown("scanner", "p", "gone"), 111),
        (Refused("scanner", "p", "TRIGGER refused, status -1000"), 111),
        (Timeout("scanner", "p", "no frame within 30 s"), 201),
        (BadReply("scanner", "p", "frame 7, want 6"), 202),
        (BadReply("scanner", "p", "frame of scanner 1, want 2"), 112),
        (WorkerDied("x"), 216),
        (WorkerTimeout("x"), 215),
        (RecordFailed("x"), 2),
        (RecordBroken("x"), 3),
        (Unfit(134, "x"), 134),
        (OSError(28, "No space left on device"), 2),
        (KeyError("x"), 136),
    ],
)
def test_every_failure_has_its_alarm(error: Exception, number: int) -> None:
    assert alarm_number(error) == number
    assert number in KINDS
    assert ends_only_the_part(error) == (number in (201, 202, 215, 216))


def test_the_block_is_what_the_record_holds() -> None:
    measurement = parts.measurement(**REPAIRED)
    verdict = judge(measurement, parts.plan(), parts.GATES)
    decision = decided(measurement, parts.plan(), verdict, parts.GATES, None, {}, NOW)
    ticket = Ticket(**{name: getattr(workload.ticket(70_000), name) for name in Ticket.__slots__})
    committed = CommittedVerdict(record_no=12, ticket=ticket, decision=decision)
    block = decode_result(result_block(committed).encode())
    assert block == result_block(committed)
    assert (block.verdict, block.sequence, block.record_id) == (VerdictCode.REPAIR, 70_000, 12)
    assert block.missing_volume_mm3_x1000 == 60_000
    assert block.defects == 1
    assert block.coverage_percent_x100 == 9900
    assert block.worst_deviation_um == 50  # the form; the chord is on nominal
    assert block.time_ms == 1_767_225_600_000


def test_figures_stay_in_their_registers() -> None:
    far = parts.measurement(sections=(parts.section(chord_mm=-1e9),), damages=(parts.damage(volume=1e12),))
    shown = figures(far, judge(far, parts.plan(), parts.GATES))
    assert shown.worst_um == -(2**31 - 1)
    assert shown.missing_mm3_x1000 == 2**32 - 1
    nothing = parts.measurement(zones=(), damages=None, sections=(), form_mm=parts.lost())
    assert figures(nothing, judge(nothing, parts.plan(), parts.GATES)) == Figures()


def test_a_measurement_as_json_names_each_difference() -> None:
    recorded = numbers(parts.measurement(**REPAIRED))
    assert list(differences(recorded, numbers(parts.measurement(**REPAIRED)))) == []
    changed = parts.measurement(**REPAIRED, sections=(parts.section(chord_mm=45.0 + 1e-6),))
    (line,) = differences(recorded, numbers(changed))
    assert line.startswith("sections[0].measurands.chord_mm.value: recorded 45.0")
    near = parts.measurement(**REPAIRED, sections=(parts.section(chord_mm=45.0 + 1e-10),))
    assert list(differences(recorded, numbers(near))) == []
    assert list(differences(recorded, numbers(parts.measurement(**REPAIRED, timing_s={"x": 9.0})))) == []
    lost = parts.measurement(**REPAIRED, sections=(parts.section(chord_mm=parts.lost()),))
    assert len(list(differences(recorded, numbers(lost)))) >= 1


def test_arrays_are_kept_when_they_are_small() -> None:
    assert numbers(np.eye(2)) == [[1.0, 0.0], [0.0, 1.0]]
    assert numbers(np.zeros((100, 3))) == {"length": [100, 3]}
    assert numbers(float("inf")) == "inf"
    assert list(differences({"a": [1]}, {"a": [1, 2]})) == ["a: recorded [1], now [1, 2]"]
    assert list(differences({"a": True}, {"a": 1})) == ["a: recorded True, now 1"]


def test_a_finding_row_is_the_finding() -> None:
    verdict = judge(parts.measurement(), parts.plan(), parts.GATES)
    for finding in verdict.findings:
        row = finding_row(finding)
        assert (row.value, row.U, row.outcome) == (finding.value, finding.U, finding.outcome.value)
