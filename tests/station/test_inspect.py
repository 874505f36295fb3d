"""A merged scan of a small analytic blade from files to verdict, and scans that are not enough."""

import errno
import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from geometry.types import Floats
from station import result
from station.clouds import BadScan
from station.formats.write import ply_cloud, stl
from station.inspect import Inspection, inspect_scan
from station.plans import BadPlan, read_plan
from station.recipe import prepare_recipe
from station.refusal import BadRequest
from tests.geometry.blades import Blade, Scan, mesh, scan, with_noise, with_tip_cut

BLADE = Blade(chord_mm=20.0, height_mm=35.0, thickness_mm=2.6, le_radius_mm=0.5, te_radius_mm=0.35)
SEEN_FROM_MM = 3.5  # below stands the fixture

PLAN = """\
schema = "bladecell.plan/1"
part_number = "SMALL"
revision = "A"
nominal = "nominal.stl"
[measurement]
sigma_mm = 0.015
[airfoil]
z_min_mm = 4.0
[sections]
z_mm = [8.0, 33.0]
[limits.section]
chord_mm = { serviceable = 0.25, repairable = 1.0 }
profile_mm = { serviceable = 0.15, repairable = 0.5 }
[limits.form]
deviation_mm = { serviceable = 0.2, repairable = 0.5 }
[limits.damage.tip]
depth_mm = { serviceable = 0.5, repairable = 6.0 }
volume_mm3 = { serviceable = 1.0, repairable = 60.0 }
count = { serviceable = 0, repairable = 1 }
[limits.damage.leading_edge]
depth_mm = { serviceable = 0.5, repairable = 3.0 }
[limits.damage.trailing_edge]
depth_mm = { serviceable = 0.5, repairable = 3.0 }
[limits.damage.surface]
depth_mm = { serviceable = 0.3, repairable = 3.0 }
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A plan, its nominal, a scan of the blade without its trailing tip corner, and scans of too little."""
    folder = tmp_path_factory.mktemp("small")
    rng = np.random.default_rng(3)
    (folder / "plan.toml").write_text(PLAN)
    (folder / "nominal.stl").write_bytes(stl([mesh(BLADE, 160, 40)]))
    cut = with_tip_cut(scan(BLADE, 25.0, rng), BLADE, 3.0, rng)
    keep(folder / "cut.ply", with_noise(cut, 0.012, rng), rng)
    np.savetxt(folder / "three.xyz", np.eye(3))
    np.savetxt(folder / "nowhere.asc", np.full((5, 3), np.nan))
    np.savetxt(folder / "line.csv", np.outer(np.linspace(0.0, 30.0, 400), [0.0, 0.0, 1.0]), delimiter=",")
    return folder


def keep(path: Path, given: Scan, rng: np.random.Generator) -> None:
    """Writes the points above the fixture, turned out of the nominal's frame."""
    points_mm: Floats = given.points_mm[given.points_mm[:, 2] > SEEN_FROM_MM]
    c, s = np.cos(0.7), np.sin(0.7)
    turned = points_mm @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T + [5.0, -3.0, 12.0]
    path.write_bytes(ply_cloud(rng.permutation(turned), np.zeros(len(turned))))


def inspect(folder: Path, name: str, out: Path) -> Inspection:
    return inspect_scan(
        folder / "plan.toml",
        folder / name,
        out,
        serial="SN-1",
        clock=time.perf_counter,
        progress=lambda step: None,
    )


@pytest.mark.timeout(500)  # the whole chain, on a machine that does other things too
def test_a_broken_tip_is_measured_and_filled(folder: Path, tmp_path: Path) -> None:
    done = inspect(folder, "cut.ply", tmp_path)
    result: dict[str, Any] = json.loads((tmp_path / "result.json").read_text())
    assert (done.result, done.verdict.verdict) == (result, "REPAIR"), result["reasons"]
    assert result["route"] == "fill"
    depth = next(f for f in result["findings"] if f["characteristic"] == "damage.tip.depth_mm")
    assert depth["value"] == pytest.approx(3.0, abs=max(depth["U"], 0.1))
    patch = trimesh.load_mesh(tmp_path / "repair-1.stl")
    assert patch.is_watertight
    assert patch.volume == pytest.approx(result["repair"]["volume_mm3"]["value"], rel=1e-4)
    T = np.array(result["alignment"]["T_nominal_scan"])
    assert T[:3, 3] == pytest.approx(-T[:3, :3] @ [5.0, -3.0, 12.0], abs=0.01)
    assert result["timing_s"]["total"] > result["timing_s"]["register"] > 0.0
    low, high = result["sections"]
    assert low["status"] == "measured"
    assert high["status"] == "in_damage"  # the break begins below 33 mm
    assert {f["outcome"] for f in result["findings"] if "[33.0]" in f["characteristic"]} == {"NOT_JUDGED"}


@pytest.mark.parametrize("name", ["three.xyz", "nowhere.asc", "line.csv"])
def test_too_little_data_is_hold_with_a_result(folder: Path, tmp_path: Path, name: str) -> None:
    done = inspect(folder, name, tmp_path)
    assert done.verdict.verdict == "HOLD"
    assert done.result["alignment"] is None
    assert (tmp_path / "report.html").stat().st_size > 1000
    assert (tmp_path / "result.json").is_file()


def test_a_section_off_the_nominal_is_refused(folder: Path, tmp_path: Path) -> None:
    plan = folder / "beyond.toml"
    plan.write_text(PLAN.replace("33.0]", "36.0]"))
    with pytest.raises(BadPlan, match=r"sections.z_mm: 36 mm is outside the nominal's span, 0 to 35 mm"):
        inspect_scan(
            plan,
            folder / "three.xyz",
            tmp_path,
            serial="1",
            clock=time.perf_counter,
            progress=lambda step: None,
        )


def test_a_section_off_the_airfoil_is_refused(folder: Path) -> None:
    (folder / "root.toml").write_text(PLAN.replace("z_min_mm = 4.0", "z_min_mm = 15.0"))
    with pytest.raises(BadPlan, match=r"sections.z_mm: 8 mm is outside the airfoil, 15 to 35 mm"):
        prepare_recipe(read_plan(folder / "root.toml"))


def test_a_slide_of_the_thesis_registration_is_never_believed(folder: Path, tmp_path: Path) -> None:
    plan = folder / "thesis.toml"
    plan.write_text(PLAN.replace("[sections]", '[algorithms]\nregistration = "thesis"\n[sections]'))
    done = inspect_scan(
        plan,
        folder / "cut.ply",
        tmp_path,
        serial="SN-1",
        clock=time.perf_counter,
        progress=lambda step: None,
    )
    assert done.verdict.verdict == "HOLD"
    assert "off the one that the ends confirm" in done.verdict.reasons[0]


def test_a_datum_point_off_the_nominal_is_a_bad_plan(folder: Path) -> None:
    points = [[0.0, 0.0, 0.0]] * 5 + [[0.0, 0.0, 400.0]]
    table = f'[alignment]\nmethod = "six_point"\npoints_mm = {points}\n[sections]'
    (folder / "datum.toml").write_text(PLAN.replace("[sections]", table))
    with pytest.raises(BadPlan, match="mm off the nominal") as caught:
        prepare_recipe(read_plan(folder / "datum.toml"))
    assert caught.value.where == "alignment.points_mm"


def test_what_is_at_fault_writes_nothing(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(BadScan):
        inspect(folder, "none.ply", tmp_path / "out")
    with pytest.raises(BadRequest):
        inspect(folder, "three.xyz", folder / "plan.toml")
    assert not (tmp_path / "out").exists()
    with pytest.raises(BadRequest, match=r"(?i)name too long"):
        inspect(folder, "three.xyz", tmp_path / ("n" * 300))


def test_a_disk_that_takes_no_more_is_one_line_and_leaves_no_parts(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "result.json").write_text("earlier")
    written: list[str] = []

    def full(path: Path, content: bytes) -> None:
        if written:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        written.append(path.name)
        path.write_bytes(content)

    monkeypatch.setattr(result, "write_beside", full)
    with pytest.raises(BadRequest, match="No space left"):
        inspect(folder, "three.xyz", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["result.json"]
    assert (tmp_path / "result.json").read_text() == "earlier"


def test_a_folder_under_the_name_of_a_result_is_one_line(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "result.json").mkdir()
    with pytest.raises(BadRequest, match=r"result\.json: Is a directory"):
        inspect(folder, "three.xyz", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["result.json"]
