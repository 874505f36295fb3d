"""The command that writes a damaged blade with its truth."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from simulators.solids import Floats, read_solid
from simulators.synth import main

REAL = Path(__file__).parents[3] / "shared" / "data" / "turbineblade" / "turbineblade.ply"
needs_real = pytest.mark.skipif(not REAL.exists(), reason="the real turbine blade is not here")


def read_scan(path: Path) -> Floats:
    head, _, body = path.read_bytes().partition(b"end_header\n")
    count = int(head.partition(b"element vertex ")[2].split()[0])
    assert len(body) == 24 * count
    return np.frombuffer(body, dtype="<f8").reshape(-1, 3)


def distance_to_nominal_mm(folder: Path, T_nominal_scan: Floats) -> Floats:
    scan = read_scan(folder / "scan.ply")[::100]
    points = scan @ T_nominal_scan[:3, :3].T + T_nominal_scan[:3, 3]
    solid = read_solid(folder / "nominal.stl")
    corners = solid.vertices_mm[solid.faces]
    faces = cKDTree(corners.mean(axis=1)).query(points, k=12)[1]
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    gaps = np.abs(np.einsum("ikj,ikj->ik", points[:, None] - a[faces], normal[faces]))
    return np.sort(gaps.min(axis=1))


def test_a_repairable_blade(tmp_path: Path) -> None:
    assert main(["--out", str(tmp_path), "--damage", "tip,pit", "--views", "8"]) == 0
    truth = json.loads((tmp_path / "truth.json").read_text())
    plan = tomllib.loads((tmp_path / "plan.toml").read_text())
    assert truth["verdict"] == "REPAIR"
    assert [damage["zone"] for damage in truth["damages"]] == ["tip", "surface"]
    assert truth["removed_mm3"] > 50.0
    assert truth["largest_gap_mm"] < 1.0  # the broken surfaces are seen too
    assert plan["schema"] == "bladecell.plan/1"
    gaps = distance_to_nominal_mm(tmp_path, np.array(truth["T_nominal_scan"]))
    assert gaps[int(0.9 * len(gaps))] < 0.1
    order = np.diff(read_scan(tmp_path / "scan.ply")[:1000, 2])
    assert (order > 0).mean() == pytest.approx(0.5, abs=0.1)  # shuffled


def test_few_views_leave_required_surface_unseen(tmp_path: Path) -> None:
    options = ["--out", str(tmp_path), "--preset", "PASS", "--views", "2", "--noise-mm", "0.03"]
    assert main(options) == 0
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert truth["verdict"] == "HOLD"
    assert truth["noise_normal_mm"] == 0.03
    assert tomllib.loads((tmp_path / "plan.toml").read_text())["measurement"]["sigma_mm"] == 0.03


def test_without_form_error_the_blade_is_the_nominal(tmp_path: Path) -> None:
    options = [
        "--out",
        str(tmp_path),
        "--no-form-error",
        "--damage",
        "none",
        "--noise-mm",
        "0",
        "--views",
        "3",
    ]
    assert main(options) == 0
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert truth["damages"] == []
    assert max(abs(section["position_x_mm"]) for section in truth["sections"]) < 1e-6
    gaps = distance_to_nominal_mm(tmp_path, np.array(truth["T_nominal_scan"]))
    assert np.median(gaps) < 0.006  # the axis as calibrated is a few micrometres from the true one


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--nominal", "nothing.stl"], "nothing.stl"),
        (["--damage", "tip,dent"], "'dent'"),
        (["--preset", "BROKEN"], "'BROKEN'"),
        (["--views", "0"], "--views"),
        (["--noise-mm", "nan"], "--noise-mm"),
        (["--z-min-mm", "200"], "airfoil"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    options: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--out", str(tmp_path / "new"), *options]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert said in printed.err
    assert not (tmp_path / "new").exists()


@needs_real
def test_a_real_blade_is_found_above_its_platform_and_damaged(tmp_path: Path) -> None:
    options = ["--out", str(tmp_path), "--nominal", str(REAL), "--damage", "tip,edge,pit", "--views", "8"]
    assert main(options) == 0
    truth = json.loads((tmp_path / "truth.json").read_text())
    plan = tomllib.loads((tmp_path / "plan.toml").read_text())
    assert 120.5 < plan["airfoil"]["z_min_mm"] < 123.5
    assert plan["airfoil"]["z_max_mm"] == pytest.approx(148.860107, abs=1e-5)
    assert len(plan["sections"]["z_mm"]) == 3
    assert [damage["zone"] for damage in truth["damages"]] == ["tip", "leading_edge", "surface"]
    assert truth["verdict"] == "REPAIR"
    assert truth["largest_gap_mm"] < 1.0
    gaps = distance_to_nominal_mm(tmp_path, np.array(truth["T_nominal_scan"]))
    assert gaps[int(0.85 * len(gaps))] < 0.1
