"""Replay: a job folder is read whole or refused, and what differs from the record is named."""

import json
import shutil
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from drivers.wire.scanner import Stamp, decode_group, encode_cloud, encode_stamp, quantise
from station import replay
from station.job import Job, add_frame, begin_job, close_unjudged, commit
from station.journal import InputFile
from station.measure import Views
from station.plans import read_plan
from station.record import Record, Ticket
from station.replay import BadJob, read_job, replay_job
from station.verdict import judge

AT = "2026-01-01T00:00:00.000+00:00"
NOW = datetime(2026, 1, 1, tzinfo=UTC)


@pytest.fixture(scope="module")
def helpers() -> SimpleNamespace:
    """The hand-made parts and the rig's files, imported by name."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parent))
        import live_rig
        import parts

        return SimpleNamespace(rig=live_rig, parts=parts)


@pytest.fixture(scope="module")
def recorded(helpers: SimpleNamespace, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A job of three frames with a REPAIR, as the live station leaves it."""
    root = tmp_path_factory.mktemp("replay")
    ports = dict.fromkeys(("turntable", "modbus", "control", "data", "plc", "events"), 1)
    helpers.rig.write_files(root, ports, mode="SIMULATION", scanner_serial=93111)
    record = Record.open(root / "record", station={"station_id": "T"}, at_utc=AT)
    job = scanned(record, root, sequence=1, views=3)
    plan, gates = read_plan(root / "plan.toml"), helpers.parts.GATES
    measurement = helpers.parts.measurement(**found(helpers))
    commit(record, job, measurement, plan, judge(measurement, plan, gates), gates, None, NOW)
    scanned(record, root, sequence=2, views=1)
    close_unjudged(record, 2, 206, "PART_PRESENT fell", NOW)
    record.close()
    return root / "record" / "jobs"


def scanned(record: Record, root: Path, *, sequence: int, views: int) -> Job:
    ticket = Ticket(
        sequence=sequence,
        serial=f"SN-{sequence}",
        recipe=1,
        fixture=0,
        plc_epoch=1,
        part_number="HPC-R3",
        simulated=True,
        at_utc=AT,
    )
    inputs = tuple(
        InputFile(role=role, source=root / name, place=name)
        for role, name in (
            ("configuration", "station.toml"),
            ("calibration", "calibration.toml"),
            ("plan", "plan.toml"),
            ("nominal", "nominal.stl"),
        )
    )
    job = begin_job(record, record.accept(ticket), ticket, inputs, {})
    rng = np.random.default_rng(sequence)
    for index in range(views):
        stamp = Stamp(frame_index=index + 1, timestamp_us=index + 1, scanner_serial=93111)
        cloud = encode_cloud(*quantise(rng.normal(0.0, 10.0, (5, 5, 3))))
        add_frame(job, encode_stamp(stamp) + cloud, 90.0 * index, index + 1)
    return job


def found(helpers: SimpleNamespace) -> dict[str, Any]:
    return {
        "points": 75,
        "damages": (helpers.parts.damage(depth=8.0),),
        "repairs": helpers.parts.repairs(helpers.parts.patch()),
    }


@pytest.fixture
def job(recorded: Path, tmp_path: Path) -> Path:
    """A copy of that job: a folder that went somewhere else."""
    return shutil.copytree(recorded / "000001", tmp_path / "000001")


@pytest.fixture
def measured(helpers: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the geometry finds in the frames; the test may change it. The views are the recorded ones."""
    outcome = {"measurement": helpers.parts.measurement(**found(helpers))}

    def conclude(views: Views, *_: object) -> Any:
        outcome["views"] = views.views
        return outcome["measurement"]

    monkeypatch.setattr(replay, "conclude", conclude)
    monkeypatch.setattr(
        replay,
        "prepare_recipe",
        lambda plan, axis: SimpleNamespace(plan=plan, plan_sha256="0" * 64, nominal_sha256="1" * 64),
    )
    return outcome


def test_the_same_numbers_are_as_recorded(job: Path, measured: dict[str, Any]) -> None:
    result = replay_job(job)
    assert result.as_recorded
    assert (result.recorded, result.again, result.serial) == ("REPAIR", "REPAIR", "SN-1")
    assert [view.angle_deg for view in measured["views"]] == [0.0, 90.0, 180.0]
    for view, frame in zip(measured["views"], sorted((job / "frames").iterdir()), strict=True):
        assert np.array_equal(view.points_mm, decode_group(frame.read_bytes()).points_mm)


def test_its_files_go_where_they_are_wanted(job: Path, measured: dict[str, Any], tmp_path: Path) -> None:
    assert replay_job(job, tmp_path / "out").as_recorded
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    assert (result["verdict"], result["serial"]) == ("REPAIR", "SN-1")


def test_a_number_that_differs_is_named(
    job: Path, measured: dict[str, Any], helpers: SimpleNamespace
) -> None:
    section = helpers.parts.section(chord_mm=45.001)
    measured["measurement"] = helpers.parts.measurement(**found(helpers), sections=(section,))
    result = replay_job(job)
    assert not result.as_recorded
    assert result.again == "REPAIR"
    assert any("measurands.chord_mm.value" in line for line in result.differences)


def test_a_verdict_that_differs_is_named(
    job: Path, measured: dict[str, Any], helpers: SimpleNamespace
) -> None:
    measured["measurement"] = helpers.parts.measurement(points=75)
    result = replay_job(job)
    assert (result.recorded, result.again, result.as_recorded) == ("REPAIR", "PASS", False)


def test_the_gates_are_those_of_the_record(job: Path, measured: dict[str, Any]) -> None:
    verdict = json.loads((job / "verdict.json").read_text())
    verdict["gates"]["calibration"] = False
    (job / "verdict.json").write_text(json.dumps(verdict))
    assert replay_job(job).again == "HOLD"


def test_a_place_that_takes_no_files_is_one_line(job: Path, measured: dict[str, Any], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadJob, match="file"):
        replay_job(job, tmp_path / "file")


def test_an_interrupted_job_is_the_hold_that_it_was(recorded: Path) -> None:
    result = replay_job(recorded / "000002")
    assert (result.recorded, result.again, result.as_recorded) == ("HOLD", "HOLD", True)


def spoil_frame(job: Path) -> None:
    frame = job / "frames" / "001.gdp"
    frame.write_bytes(frame.read_bytes()[:-1] + b"\x7f")


def spoil_plan(job: Path) -> None:
    plan = job / "inputs" / "plan.toml"
    text = plan.read_text()
    plan.unlink()  # the record's own copy is the same file
    plan.write_text(text.replace("15.0", "99.0"))


def lead_out(job: Path) -> None:
    inputs = json.loads((job / "inputs.json").read_text())
    inputs["plan"]["file"] = "../../etc/passwd"
    (job / "inputs.json").write_text(json.dumps(inputs))


def lead_frame_out(job: Path) -> None:
    frames = json.loads((job / "frames.json").read_text())
    frames[0]["file"] = "../000002/frames/000.gdp"
    (job / "frames.json").write_text(json.dumps(frames))


def spoil_angle(angle: str) -> Callable[[Path], None]:
    def spoil(job: Path) -> None:
        rows = json.loads((job / "frames.json").read_text())
        rows[1]["angle_deg"] = json.loads(angle)
        (job / "frames.json").write_text(json.dumps(rows))

    return spoil


def forget_plan(job: Path) -> None:
    inputs = json.loads((job / "inputs.json").read_text())
    del inputs["plan"]
    (job / "inputs.json").write_text(json.dumps(inputs))


@pytest.mark.parametrize(
    "spoil",
    [
        lead_frame_out,
        spoil_angle('"30"'),
        spoil_angle("null"),
        spoil_angle("NaN"),
        forget_plan,
        lambda job: (job / "measurement.json").write_text("[" * 100_000),
        spoil_frame,
        spoil_plan,
        lead_out,
        lambda job: (job / "frames" / "002.gdp").unlink(),
        lambda job: (job / "ticket.json").write_text("{}"),
        lambda job: (job / "frames.json").write_text("[1]"),
        lambda job: (job / "verdict.json").write_text('{"verdict": "PASS"}'),
        lambda job: (job / "measurement.json").unlink(),
        shutil.rmtree,
    ],
)
def test_a_folder_that_is_not_whole_is_refused_in_one_line(job: Path, spoil: Any) -> None:
    spoil(job)
    with pytest.raises(BadJob) as caught:
        read_job(job)
    assert str(job) in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
