"""The document keeps the contract's shape, and a folder never holds half a result."""

import csv
import io
import json
import os
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from geometry.sections.profile import ZoneArc
from geometry.transforms import about_z, apply, rigid
from geometry.types import Zone
from station.document import Inputs, document, document_text
from station.gates import Gate
from station.measurement import Measurement
from station.report import fixed, render
from station.result import replace_files, write_inspection
from station.software import software_commit
from station.tables import COLUMNS, sections_csv
from station.verdict import Word, judge
from tests.station.parts import (
    GATES,
    alignment,
    damage,
    lost,
    measurement,
    number,
    patch,
    plan,
    repairs,
    section,
)

INPUTS = Inputs(
    serial="SN-1", scan_sha256="a" * 64, plan_sha256="b" * 64, nominal_sha256="c" * 64, scan_name="scan.ply"
)

QUANTITY = {"value": 0.0, "sigma": 0.0, "unit": "mm"}
CONTRACT: dict[str, Any] = {
    "schema": "bladecell.result/1",
    "verdict": "REPAIR",
    "route": "fill",
    "reasons": [""],
    "part_number": "",
    "serial": "",
    "alignment": {
        "method": "",
        "T_nominal_scan": [[0.0]],
        "rms_mm": 0.0,
        "inlier_fraction": 0.0,
        "iterations": 0,
        "converged": True,
        "information": [[0.0]],
    },
    "sections": [
        {
            "z_mm": 0.0,
            "status": "",
            "reason": None,
            "covered_fraction": 0.0,
            "not_measured": {},
            "measurands": dict.fromkeys(
                (
                    "position_x_mm",
                    "position_y_mm",
                    "position_mm",
                    "orientation_deg",
                    "profile_max_mm",
                    "profile_min_mm",
                    "chord_mm",
                    "max_thickness_mm",
                    "le_radius_mm",
                    "te_radius_mm",
                    "stagger_deg",
                ),
                QUANTITY,
            ),
        }
    ],
    "zones": [{"zone": "", "covered_fraction": 0.0, "largest_gap_mm": 0.0, "status": ""}],
    "damages": [
        {
            "zone": "",
            "kind": "",
            "depth_mm": QUANTITY,
            "area_mm2": QUANTITY,
            "volume_mm3": QUANTITY,
            "centroid_mm": [0.0],
        }
    ],
    "repair": {
        "volume_mm3": QUANTITY,
        "patches": [{"zone": "", "mesh": "", "watertight": True, "volume_mm3": QUANTITY}],
    },
    "findings": [
        {
            "characteristic": "",
            "value": 0.0,
            "deviation": 0.0,
            "U": 0.0,
            "serviceable": 0.0,
            "repairable": 0.0,
            "outcome": "",
        }
    ],
    "timing_s": dict.fromkeys(
        ("read", "clean", "register", "sections", "damage", "twin", "repair", "total"), 0.0
    ),
    "inputs": {"scan_sha256": "", "plan_sha256": "", "nominal_sha256": "", "points": 0},
    "software": {"version": "", "commit": ""},
}


def broken() -> Measurement:
    """A blade that is repaired, with a section that its damage touches."""
    return measurement(
        damages=(damage(), damage(Zone.SURFACE, depth=lost("no points"), volume=0.3)),
        repairs=repairs(patch(0)),
        sections=(section(7.0, chord_mm=lost(in_damage=True)),),
    )


def written(given: Measurement = broken()) -> dict[str, Any]:
    result = document(given, judge(given, plan(), GATES), plan(), INPUTS)
    return dict(json.loads(document_text(result)))


def assert_shape(wanted: Any, found: Any, where: str = "$") -> None:
    """Every key of the contract is there with its type; more keys may be."""
    if isinstance(wanted, dict):
        assert isinstance(found, dict), where
        for key, value in wanted.items():
            assert key in found, f"{where}.{key}"
            if found[key] is not None:
                assert_shape(value, found[key], f"{where}.{key}")
    elif isinstance(wanted, list):
        assert isinstance(found, list), where
        for item in found if wanted else ():
            assert_shape(wanted[0], item, where)
    elif isinstance(wanted, float):
        assert isinstance(found, float | int), where
        assert not isinstance(found, bool), where
    elif wanted is not None:
        assert isinstance(found, type(wanted)), where


def test_the_document_has_the_contracts_shape() -> None:
    assert_shape(CONTRACT, written())


def test_what_was_not_measured_is_null_with_its_reason() -> None:
    result = written()
    torn, pit = result["sections"][0], result["damages"][1]
    assert torn["measurands"]["chord_mm"] is None
    assert torn["not_measured"] == {"chord_mm": "a gap of 2.0 mm"}
    assert pit["depth_mm"] is None
    assert pit["not_measured"]["depth_mm"] == "no points"
    finding = next(f for f in result["findings"] if f["characteristic"] == "sections[7.0].chord_mm")
    assert (finding["value"], finding["outcome"]) == (None, "NOT_JUDGED")


def test_a_part_that_could_not_be_measured_still_has_a_document() -> None:
    nothing = Measurement(points=3, failures={"register": "3 scan points are fewer than 200"})
    result = written(nothing)
    assert_shape(CONTRACT, result)
    assert (result["verdict"], result["alignment"], result["repair"]) == ("HOLD", None, None)
    assert result["damages"] == result["zones"] == result["sections"] == []
    assert result["not_measured"] == nothing.failures


def test_only_patches_that_are_needed_are_in_the_repair() -> None:
    both = measurement(
        damages=(damage(Zone.SURFACE, depth=0.1, volume=0.2), damage()),
        repairs=repairs(patch(0, volume_mm3=0.2), patch(1, volume_mm3=60.0)),
    )
    repair = written(both)["repair"]
    assert [each["damage"] for each in repair["patches"]] == [1]
    assert repair["volume_mm3"] == {"value": 60.0, "sigma": 0.2, "unit": "mm3"}
    assert repair["patches"][0]["mesh"] == "repair-1.stl"


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_number_that_is_not_finite_is_never_written(tmp_path: Path, bad: float) -> None:
    given = measurement(alignment=alignment(rms_mm=bad))
    with pytest.raises(ValueError, match="JSON"):
        write_inspection(tmp_path / "out", given, judge(given, plan(), GATES), plan(), INPUTS)
    assert not (tmp_path / "out").exists()


def test_a_pose_without_a_rival_has_no_ratio() -> None:
    assert written(measurement(alignment=alignment(runner_up_ratio=float("inf"))))["alignment"]["converged"]


def test_the_pose_is_stated_with_what_noise_and_the_unseen_leave_open() -> None:
    noise, unseen = np.diag([1e8] * 3 + [1e4] * 3), np.diag([0.0] * 5 + [3e-4])
    found = written(measurement(alignment=alignment(information=noise, unseen_covariance=unseen)))
    assert found["alignment"]["sigma_deg"] == pytest.approx([np.rad2deg(1e-4)] * 3, rel=1e-3)
    assert found["alignment"]["sigma_mm"] == pytest.approx([0.01, 0.01, 0.02], rel=1e-3)


# The folder


def inspected(folder: Path, given: Measurement) -> dict[str, Any]:
    return write_inspection(folder, given, judge(given, plan(), GATES), plan(), INPUTS)


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


ALWAYS = {"result.json", "report.html", "sections.csv", "deviation.ply", "twin.ply"}


def test_a_repair_has_all_its_files(tmp_path: Path) -> None:
    two = measurement(
        damages=(damage(), damage(Zone.SURFACE, depth=1.0)), repairs=repairs(patch(0), patch(1))
    )
    inspected(tmp_path / "out", two)
    assert names(tmp_path / "out") == ALWAYS | {"repair.stl", "repair.3mf", "repair-1.stl", "repair-2.stl"}
    for name in ("repair-1.stl", "repair-2.stl"):
        assert trimesh.load_mesh(tmp_path / "out" / name).is_watertight
    assert trimesh.load_mesh(tmp_path / "out" / "twin.ply").is_watertight
    assert len(trimesh.load(tmp_path / "out" / "deviation.ply").vertices) == 200


def test_patches_come_in_the_frames_that_the_plan_wants(tmp_path: Path) -> None:
    T_nominal_scan = rigid(about_z(30.0)[:3, :3], np.array([1.0, -2.0, 50.0]))
    given = measurement(
        alignment=alignment(T_nominal_scan=T_nominal_scan), damages=(damage(),), repairs=repairs(patch(0))
    )
    T_fixture_scan = rigid(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 12.0]))
    wanted = plan(repair={"frames": ["scan", "fixture"], "T_fixture_scan": T_fixture_scan.tolist()})
    write_inspection(tmp_path, given, judge(given, wanted, GATES), wanted, INPUTS)
    nominal, scan, fixture = (
        np.asarray(trimesh.load_mesh(tmp_path / f"repair{frame}.stl").triangles).reshape(-1, 3)
        for frame in ("", "-scan", "-fixture")
    )
    np.testing.assert_allclose(apply(T_nominal_scan, scan), nominal, atol=1e-4)
    np.testing.assert_allclose(apply(T_fixture_scan, scan), fixture, atol=1e-4)
    inspected(tmp_path, given)
    assert names(tmp_path) == ALWAYS | {"repair.stl", "repair.3mf", "repair-1.stl"}


def test_an_allowance_is_in_the_files_and_apart_in_the_document(tmp_path: Path) -> None:
    thick = replace(patch(0), allowance_mm=0.1)
    inspected(tmp_path, measurement(damages=(damage(),), repairs=repairs(thick)))
    written = json.loads((tmp_path / "result.json").read_text())["repair"]["patches"][0]
    assert written["allowance_mm"] == 0.1
    assert written["volume_mm3"]["value"] == 60.0
    mesh = trimesh.load_mesh(tmp_path / "repair-1.stl")
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(written["written_mm3"]["value"], rel=1e-4)
    assert mesh.volume > 1.1 * trimesh.Trimesh(thick.mesh.vertices_mm, thick.mesh.faces).volume


def test_our_own_files_are_replaced_and_foreign_ones_are_not(tmp_path: Path) -> None:
    inspected(tmp_path, broken())
    for name in ("notes.txt", "repair-0.stl", "repair-x.stl", "my-result.json"):
        (tmp_path / name).write_text("foreign")
    foreign = {"notes.txt", "repair-0.stl", "repair-x.stl", "my-result.json"}
    assert names(tmp_path) == ALWAYS | {"repair.stl", "repair.3mf", "repair-1.stl"} | foreign
    inspected(tmp_path, measurement())
    assert names(tmp_path) == ALWAYS | foreign
    assert json.loads((tmp_path / "result.json").read_text())["verdict"] == "PASS"
    inspected(tmp_path, Measurement(points=3, failures={"register": "too few"}))
    assert names(tmp_path) == {"result.json", "report.html", "sections.csv"} | foreign
    assert {(tmp_path / name).read_text() for name in foreign} == {"foreign"}


def test_the_result_takes_its_name_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    order: list[str] = []
    real = Path.replace

    def noted(self: Path, target: Path) -> Path:
        order.append(Path(target).name)
        return real(self, target)

    monkeypatch.setattr(Path, "replace", noted)
    inspected(tmp_path, broken())
    assert order[-1] == "result.json"
    assert set(order) == names(tmp_path)


def test_a_failed_write_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inspected(tmp_path, measurement())
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        inspected(tmp_path, broken())
    monkeypatch.undo()
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.name in before} == before
    inspected(tmp_path, broken())  # what the failure left is no obstacle
    assert names(tmp_path) == ALWAYS | {"repair.stl", "repair.3mf", "repair-1.stl"}


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("mine")
    out = tmp_path / "out"
    out.mkdir()
    (out / ".result.json.part").symlink_to(victim)
    (out / "result.json").symlink_to(victim)
    replace_files(out, {"result.json": b"{}"})
    assert victim.read_text() == "mine"
    assert (out / "result.json").read_bytes() == b"{}"


def test_the_same_measurement_gives_the_same_bytes(tmp_path: Path) -> None:
    inspected(tmp_path / "a", broken())
    inspected(tmp_path / "b", broken())
    for name in names(tmp_path / "a"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_the_commit_is_that_of_this_checkout() -> None:
    assert re.fullmatch(r"[0-9a-f]{40}|unknown", software_commit())


# sections.csv


def test_the_table_has_one_row_a_measurand() -> None:
    given = broken()
    table = list(csv.reader(io.StringIO(sections_csv(given, judge(given, plan(), GATES)))))
    assert tuple(table[0]) == COLUMNS
    by_name = {row[1]: dict(zip(COLUMNS, row, strict=True)) for row in table[1:]}
    assert set(given.sections[0].measurands) == set(by_name)
    assert by_name["chord_mm"]["actual"] == ""
    assert by_name["chord_mm"]["outcome"] == "NOT_JUDGED"
    assert by_name["chord_mm"]["reason"] == "a gap of 2.0 mm"
    assert float(by_name["stagger_deg"]["actual"]) == 30.0
    assert by_name["stagger_deg"]["serviceable"] == ""


# The report


class Reader(HTMLParser):
    """Collects text, tags that stay open, and every address that is asked for."""

    VOID = frozenset({"meta", "img", "br", "link", "input"})

    def __init__(self) -> None:
        super().__init__()
        self.text, self.open, self.addresses = [""], [""], [""]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in self.VOID:
            self.open.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("src", "href")]

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def report(given: Measurement, inputs: Inputs = INPUTS) -> Reader:
    verdict = judge(given, plan(), GATES)
    reader = Reader()
    reader.feed(render(document(given, verdict, plan(), inputs), given, verdict, plan()))
    assert reader.open == [""]
    return reader


@pytest.mark.parametrize(
    "given",
    [
        measurement(),
        broken(),
        measurement(damages=(damage(depth=20.0),)),
        measurement(sections=(), zones=(), damages=None, repairs=None, twin_mesh=None),
        Measurement(points=0, failures={"register": "no points"}),
    ],
)
def test_every_outcome_has_a_report_that_needs_nothing_else(given: Measurement) -> None:
    reader = report(given)
    word = judge(given, plan(), GATES).verdict
    assert word in "".join(reader.text)
    assert all(address == "" or address.startswith("data:image/png;base64,") for address in reader.addresses)
    assert "non-destructive testing" in "".join(reader.text)


def test_the_report_tells_how_a_patch_meets_the_sound_skin() -> None:
    met = replace(patch(0), border_angle_deg=number("border_angle_deg", 7.3))
    text = "".join(report(replace(broken(), repairs=repairs(met))).text)
    assert "7.3" in text
    assert "7.3" not in "".join(report(broken()).text)


def test_the_report_tells_how_well_each_side_of_a_section_was_seen() -> None:
    arcs = {"le": (0.91, 0.0), "ss": (1.0, 0.12), "te": (0.5, 3.21), "ps": (0.99, 0.4)}
    seen = {side: ZoneArc(covered_fraction=part, largest_gap_mm=gap) for side, (part, gap) in arcs.items()}
    text = " ".join("".join(report(measurement(sections=(replace(section(), zones=seen),))).text).split())
    assert (
        "Arc with points, and the largest gap: leading edge 91.0 %, 0.00 mm; suction side 100.0 %, 0.12 mm; "
        "trailing edge 50.0 %, 3.21 mm; pressure side 99.0 %, 0.40 mm."
    ) in text
    assert "largest gap:" not in "".join(report(measurement()).text)


def test_a_serial_number_cannot_become_markup() -> None:
    hostile = replace(INPUTS, serial="<script>alert(1)</script>")
    assert "<script>alert(1)</script>" in "".join(report(measurement(), hostile).text)


def test_a_simulated_part_says_so() -> None:
    assert "NOT A RELEASE" in "".join(report(measurement(), replace(INPUTS, simulated=True)).text)
    assert "NOT A RELEASE" not in "".join(report(measurement()).text)


def test_an_open_gate_is_the_first_reason_in_the_report() -> None:
    given = measurement()
    verdict = judge(given, plan(), replace(GATES, calibration=Gate(holds=False, reason="9 days old")))
    assert verdict.verdict == Word.HOLD
    page = render(document(given, verdict, plan(), INPUTS), given, verdict, plan())
    assert "calibration: 9 days old" in page


def test_numbers_have_a_true_minus_sign_and_a_dash_for_none() -> None:
    assert (fixed(-0.12345), fixed(None), fixed(1.0, 1)) == ("−0.123", "–", "1.0")


def test_a_section_of_which_nothing_was_measured_has_no_plot() -> None:
    bare = replace(
        section(), profile_mm=np.empty((0, 2)), deviation_mm=np.empty(0), run=np.empty(0, np.int64)
    )
    report(measurement(sections=(bare,)))
    report(measurement(outlines=()))


def test_a_borderline_form_is_drawn() -> None:
    report(measurement(form_mm=number("form_mm", 0.9)))


def test_the_area_from_which_damage_is_found_is_stated_or_its_lack_is() -> None:
    given = measurement()
    verdict = judge(given, plan(), GATES)
    result = document(given, verdict, plan(), INPUTS)
    assert result["detection"]["area_mm2"] == {"value": 3.0, "sigma": 0.0, "unit": "mm2"}
    assert "covers 3.0 mm² or more" in render(result, given, verdict, plan())
    blind = measurement(detection_mm2=lost("no twin"))
    result = document(blind, verdict, plan(), INPUTS)
    assert result["detection"]["area_mm2"] is None
    assert result["detection"]["not_measured"] == {"area_mm2": "no twin"}
    assert "mm² or more" not in render(result, blind, verdict, plan())
