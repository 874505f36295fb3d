"""The record: append-only, chained, proven twice, and whole after a kill at any line."""

import importlib.util
import json
import os
import random
import shutil
import sqlite3
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from station.chain import RecordBroken, RecordFailed
from station.events import FindingRow
from station.job import close_abandoned, recover
from station.journal import job_folder, keep_json
from station.proof import Decision, unproven
from station.record import (
    AnotherStation,
    DuplicateRequest,
    Record,
    Request,
    read_requests,
    verify,
)

HERE = Path(__file__).parent


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, HERE / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


workload = load("record_workload")
AT = workload.AT


def opened(directory: Path) -> Record:
    return Record.open(directory, station={"station_id": "T"}, at_utc=AT)


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("template") / "record"
    workload.work(directory)
    return directory


@pytest.fixture
def directory(tmp_path: Path, template: Path) -> Path:
    """A record with the requests of the workload."""
    return shutil.copytree(template, tmp_path / "record")


NOW = datetime(2026, 1, 1, tzinfo=UTC)


def decided(record: Record, sequence: int, word: str) -> int:
    """A request whose verdict is committed and was never shown."""
    number = int(record.accept(workload.ticket(sequence)))
    record.decide(number, workload.decision(word))
    return number


def test_a_verdict_that_a_fault_kept_back_never_comes_back(tmp_path: Path) -> None:
    record = opened(tmp_path)
    first, second = decided(record, 1, "PASS"), record.accept(workload.ticket(2))
    close_abandoned(record, "a fault", NOW, shown=False)
    assert record.request(first).phase == "UNDELIVERED"
    assert record.request(second).verdict == "HOLD"
    assert recover(record, NOW) == ((), None)
    record.close()


def test_only_the_newest_verdict_is_shown_again_after_a_restart(tmp_path: Path) -> None:
    record = opened(tmp_path)
    first, second = decided(record, 1, "PASS"), decided(record, 2, "SCRAP")
    _, standing = recover(record, NOW)
    assert standing is not None
    assert standing.record_no == second
    assert record.request(first).phase == "UNDELIVERED"
    record.published(second, AT)
    record.acked(second, 1, AT)
    assert recover(record, NOW) == ((), None)
    record.close()


def test_a_request_runs_from_accepted_to_acked(tmp_path: Path) -> None:
    record = opened(tmp_path)
    number = record.accept(workload.ticket(9))
    assert record.request(number).phase == "ACCEPTED"
    committed = record.decide(number, workload.decision("REPAIR"))
    assert committed.decision == workload.decision("REPAIR")
    record.published(number, AT)
    assert record.request(number).stands
    record.acked(number, 1, AT)
    assert not record.request(number).stands
    assert not record.request(number).released  # a REPAIR is not a release
    record.close()
    assert [r.verdict for r in read_requests(tmp_path)] == ["REPAIR"]
    assert verify(tmp_path) == ()


def test_the_epoch_differs_from_start_to_start(tmp_path: Path) -> None:
    epochs = []
    for _ in range(3):
        record = opened(tmp_path)
        epochs.append(record.epoch)
        record.close()
    assert epochs == [1, 2, 3]


def test_one_sequence_one_record(directory: Path) -> None:
    record = opened(directory)
    with pytest.raises(DuplicateRequest):
        record.accept(workload.ticket(3))
    past = record.past(3)
    assert past is not None
    assert past.ticket.serial == "SN-3"
    record.close()


def test_a_second_station_changes_nothing(directory: Path) -> None:
    record = opened(directory)
    before = {path.name: path.read_bytes() for path in directory.glob("*.*")}
    with pytest.raises(AnotherStation):
        opened(directory)
    assert before == {path.name: path.read_bytes() for path in directory.glob("*.*")}
    record.close()


def test_only_a_pass_that_was_carried_out_is_released(directory: Path) -> None:
    requests = read_requests(directory)
    assert [r.verdict for r in requests] == list(workload.WORDS)
    assert [r.released for r in requests] == [False, False, True]
    assert not replace(requests[2], ack_code=2).released
    assert not replace(requests[2], phase="PUBLISHED", ack_code=None).released


def test_what_must_not_be_delivered_is_a_hold(tmp_path: Path) -> None:
    record = opened(tmp_path)
    number = record.accept(workload.ticket(1))
    record.decide(number, workload.decision("PASS"))
    record.undelivered(number, "the part left", AT)
    assert record.request(number).verdict == "HOLD"
    assert not record.request(number).stands
    with pytest.raises(RecordBroken):
        record.published(number, AT)
    record.close()
    assert verify(tmp_path) == ()


@pytest.mark.parametrize(
    "fields",
    [
        {"reasons": ()},
        {"verdict": "PASS", "findings": ()},
        {"verdict": "PASS", "findings": (workload.row("REPAIR"),)},
        {"verdict": "PASS", "gates": {"calibration": False}},
        {"verdict": "PASS", "gates": {}},
        {"verdict": "PASS", "evidence": {"alignment": True, "coverage": True, "damage": True}},
        {"verdict": "SCRAP", "findings": (workload.row("SCRAP"),), "evidence": {"alignment": False}},
        {"verdict": "PASS", "interrupted": True},
        {"verdict": "REPAIR", "findings": (workload.row("PASS"),)},
        {"verdict": "REPAIR", "findings": (workload.row("REPAIR"), workload.row("SCRAP"))},
        {"verdict": "SCRAP", "findings": (workload.row("REPAIR"),)},
        {"verdict": "SCRAP", "findings": (replace(workload.row("SCRAP"), U=1.5),)},
        {"verdict": "PASS", "findings": (replace(workload.row("PASS"), deviation=0.195),)},
        {"verdict": "PASS", "findings": (replace(workload.row("PASS"), U=None),)},
        {"verdict": "PASS", "findings": (replace(workload.row("PASS"), deviation=float("nan")),)},
        {"verdict": "MAYBE"},
    ],
)
def test_a_decision_that_its_numbers_do_not_carry_is_never_committed(
    tmp_path: Path, fields: dict[str, Any]
) -> None:
    record = opened(tmp_path)
    number = record.accept(workload.ticket(1))
    word = fields.pop("verdict", "HOLD")
    bad = workload.decision("HOLD", **(fields | {"verdict": word}))
    with pytest.raises(RecordFailed):
        record.decide(number, bad)
    assert record.request(number).decision is None
    record.close()


ROWS = st.builds(
    FindingRow,
    characteristic=st.just("form.deviation_mm"),
    value=st.floats(-3.0, 3.0) | st.none(),
    deviation=st.floats(-3.0, 3.0) | st.none(),
    U=st.floats(0.0, 0.5) | st.none(),
    serviceable=st.just(0.5),
    repairable=st.just(1.5),
    outcome=st.sampled_from(["PASS", "REPAIR", "SCRAP", "HOLD", "NOT_JUDGED"]),
)


@given(st.lists(ROWS, max_size=4), st.sampled_from(["PASS", "REPAIR", "SCRAP"]))
@settings(max_examples=300, deadline=None)
def test_the_proof_is_the_rule_of_the_contract(rows: list[FindingRow], word: str) -> None:
    """What is proven to PASS lies inside every serviceable limit, by an arithmetic of its own."""
    decision = workload.decision(word, findings=tuple(rows))
    if unproven(decision) is not None:
        return
    judged = [row for row in rows if row.outcome != "NOT_JUDGED"]
    low, high = [], []
    for row in judged:
        value = row.value if row.deviation is None else abs(row.deviation)
        if value is not None and row.U is not None:
            low.append(value - row.U)
            high.append(value + row.U)
    if word == "PASS":
        assert judged
        assert len(high) == len(judged)
        assert max(high) <= 0.5
    elif word == "REPAIR":
        assert max(low) > 0.5
        assert max(high) <= 1.5
    else:
        assert max(low) > 1.5


def test_sqlite_refuses_to_change_or_remove_an_entry(directory: Path) -> None:
    db = sqlite3.connect(directory / "record.sqlite")
    for statement in ("UPDATE entry SET body = '{}'", "DELETE FROM entry"):
        with pytest.raises(sqlite3.IntegrityError, match="append-only"):
            db.execute(statement)
    db.close()


def tamper(directory: Path, statement: str) -> None:
    """What somebody does who knows how to drop a trigger and put it back."""
    db = sqlite3.connect(directory / "record.sqlite", isolation_level=None)
    triggers = db.execute("SELECT name, sql FROM sqlite_master WHERE type = 'trigger'").fetchall()
    for name, _ in triggers:
        db.execute(f"DROP TRIGGER {name}")
    db.execute(statement)
    for _, sql in triggers:
        db.execute(sql)
    db.close()


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE entry SET body = replace(body, 'HOLD', 'PASS') WHERE phase = 'DECIDED'",
        "UPDATE entry SET body = replace(body, 'SN-1', 'SN-8') WHERE entry_no = 2",
        "UPDATE entry SET record_no = 7 WHERE entry_no = 5",
        "UPDATE entry SET sequence = 99 WHERE entry_no = 3",
        "UPDATE entry SET phase = 'UNDELIVERED' WHERE phase = 'PUBLISHED'",
        "UPDATE entry SET hash = printf('%064d', entry_no) WHERE entry_no = 4",
        "DELETE FROM entry WHERE entry_no = 6",
        "DELETE FROM entry WHERE entry_no = (SELECT max(entry_no) FROM entry)",
        "INSERT INTO entry VALUES (-1, 9, 9, 'ACCEPTED', '{}', '', 'x')",
        "DROP INDEX one_request",
    ],
)
def test_every_change_behind_our_back_is_seen(directory: Path, statement: str) -> None:
    assert verify(directory) == ()
    tamper(directory, statement)
    assert verify(directory) != ()
    with pytest.raises(RecordFailed):
        opened(directory)


def test_changed_missing_and_foreign_files_are_seen(directory: Path) -> None:
    frame = job_folder(directory, 1) / "frames" / "000.gdp"
    content = frame.read_bytes()
    frame.write_bytes(content[:-1] + b"\xff")
    assert verify(directory) == (f"{frame}: not the file that was recorded",)
    frame.unlink()
    assert verify(directory) == (f"{frame}: missing",)
    frame.write_bytes(content)
    assert verify(directory) == ()
    (directory / "jobs" / "000099").mkdir()
    assert len(verify(directory)) == 1


def test_an_older_copy_of_the_record_is_seen(directory: Path, tmp_path: Path) -> None:
    shutil.copy(directory / "record.sqlite", tmp_path / "old")
    record = opened(directory)
    record.accept(workload.ticket(50))
    record.close()
    shutil.copy(tmp_path / "old", directory / "record.sqlite")
    assert "ends before" in verify(directory)[0]
    (directory / "record.sqlite").unlink()
    assert verify(directory) != ()
    with pytest.raises(RecordFailed):
        opened(directory)


@pytest.mark.parametrize("text", ["[]", "{}", "null", '{"entry_no": "1", "hash": 1}', "[" * 100_000, "x"])
def test_an_anchor_that_names_no_entry_is_one_line(directory: Path, text: str) -> None:
    (directory / "anchor.json").write_text(text)
    assert len(verify(directory)) == 1
    with pytest.raises(RecordBroken, match="anchor"):
        opened(directory)


@pytest.mark.parametrize("content", [b"", b"not a database" * 100])
def test_a_file_that_is_no_record_is_refused(directory: Path, content: bytes) -> None:
    (directory / "record.sqlite").write_bytes(content)
    assert verify(directory) != ()
    with pytest.raises(RecordFailed):
        opened(directory)


def test_a_locked_store_fails_and_works_again_only_after_it_was_opened_again(
    directory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("station.chain.BUSY_S", 0.05)
    record = opened(directory)
    other = sqlite3.connect(directory / "record.sqlite", isolation_level=None)
    other.execute("BEGIN EXCLUSIVE")
    with pytest.raises(RecordFailed, match="locked"):
        record.accept(workload.ticket(60))
    other.execute("ROLLBACK")
    other.close()
    with pytest.raises(RecordFailed, match="failed before"):
        record.accept(workload.ticket(60))
    record.reopen()
    assert record.accept(workload.ticket(60)) == 4
    record.close()
    assert verify(directory) == ()


def test_a_failing_fsync_is_never_tried_again(directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record = opened(directory)

    def fail(_: int) -> None:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fail)
        with pytest.raises(RecordFailed, match="Input/output"):
            record.accept(workload.ticket(61))
    with pytest.raises(RecordFailed, match="failed before"):
        record.accept(workload.ticket(62))
    record.close()


def test_numbers_that_are_not_finite_are_never_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON"):
        keep_json(tmp_path, "x.json", {"value": float("nan")})
    assert not (tmp_path / "x.json").exists()


def test_a_decision_survives_its_json() -> None:
    for word in ("PASS", "REPAIR", "SCRAP", "HOLD"):
        decision = workload.decision(word)
        assert Decision.from_body(json.loads(json.dumps(decision.body()))) == decision


def check_after_kill(directory: Path) -> tuple[Request, ...]:
    """What must hold of a record whose station was killed, before and after it starts again."""
    latched = [line.split() for line in (directory / "plc.log").read_text().splitlines()]
    words = dict(zip(map(str, range(1, 9)), workload.WORDS, strict=False))
    requests = read_requests(directory)
    assert verify(directory) == ()
    decided = {str(r.ticket.sequence): r.decision.verdict for r in requests if r.decision is not None}
    for sequence, word in latched:
        assert decided[sequence] == word == words[sequence]
    for request in requests:
        word = words[str(request.ticket.sequence)]
        assert request.decision is None or request.decision.verdict == word or request.decision.interrupted
    return requests


@pytest.mark.timeout(120)
def test_killed_at_any_line_nothing_is_lost_and_nothing_is_told_twice(tmp_path: Path) -> None:
    """SIGKILL at seeded lines of the record's code: the PLC's log is always covered, the chain holds, and the
    next start closes what was open exactly once."""
    chance = random.Random(20260101)
    command = [sys.executable, str(HERE / "record_workload.py"), str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": str(HERE.parents[1])}
    subprocess.run([*command, "1000000"], check=True, env=environment, timeout=60)
    count = int((tmp_path / "1000000" / "count").read_text())
    kills = sorted(chance.sample(range(1, count), 16))
    subprocess.run([*command, *map(str, kills)], check=True, env=environment, timeout=90)
    for kill_at in kills:
        directory = tmp_path / str(kill_at)
        (directory / "plc.log").touch()
        if not (directory / "record.sqlite").exists():
            continue
        check_after_kill(directory)
        workload.work(directory)
        requests = check_after_kill(directory)
        assert len(requests) == len(workload.WORDS)
        assert all(request.decision is not None for request in requests)
        latched = [line.split()[0] for line in (directory / "plc.log").read_text().splitlines()]
        assert len(latched) - len(set(latched)) <= 1  # redelivered, with the same word
