"""Each preset's truth, judged again from the plan file by a second reading of the decision."""

import json
import re
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from simulators.parts import SimPart
from simulators.preset_names import PRESETS, preset_named
from simulators.presets import (
    make_part,
    nominal_blade,
    part_for,
    rig_for,
    write_recipe,
)
from simulators.recipe import Finding, decide
from simulators.rig import about_z, apply, inverse
from simulators.solids import face_normals, read_solid, to_manifold

EXPECTED = {
    "PASS": "PASS",
    "PASS-nick": "PASS",
    "REPAIR": "REPAIR",
    "REPAIR-weld": "REPAIR",
    "REPAIR-bent": "REPAIR",
    "SCRAP": "SCRAP",
    "HOLD-hole": "HOLD",
    "HOLD-wrong-part": "HOLD",
}


@cache
def part(preset: str) -> SimPart:
    return part_for(preset, 12, 0)


def limits_of(plan: dict[str, Any], name: str) -> dict[str, float]:
    group, _, key = name.rpartition(".")
    if group == "form":
        return plan["limits"]["form"][key]
    if group.startswith("sections["):
        return plan["limits"]["section"][key]
    return plan["limits"]["damage"][group.removeprefix("damage.")][key]


@pytest.mark.parametrize("preset", PRESETS)
def test_the_truth_is_the_verdict_of_its_name_under_the_written_plan(preset: str, tmp_path: Path) -> None:
    plan = tomllib.loads(write_recipe(tmp_path, preset, 12).read_text())
    truth = part(preset).truth
    beyond = set()
    for finding in truth["findings"]:
        limits = limits_of(plan, finding["name"])
        for grade in ("serviceable", "repairable"):
            assert finding[grade] == limits[grade]
            assert not 0.75 * limits[grade] < finding["value"] < 1.3 * limits[grade], finding["name"]
            if finding["value"] > limits[grade]:
                beyond.add(grade)
    found = "SCRAP" if "repairable" in beyond else "REPAIR" if beyond else "PASS"
    assert truth["verdict"] == EXPECTED[preset]
    assert preset.startswith("HOLD") or truth["verdict"] == found


@pytest.mark.parametrize("preset", PRESETS)
def test_the_truth_is_a_document_and_the_part_a_solid(preset: str) -> None:
    made = part(preset)
    document = json.loads(json.dumps(made.truth, allow_nan=False))
    assert set(document) >= {
        "verdict",
        "T_nominal_scan",
        "removed_mm3",
        "damages",
        "sections",
        "noise_normal_mm",
        "seed",
    }
    missing = [damage for damage in document["damages"] if damage["kind"] == "missing"]
    assert document["removed_mm3"] == pytest.approx(sum(damage["volume_mm3"] for damage in missing))
    assert re.fullmatch(r"[A-Z0-9-]{1,32}", made.serial)
    assert to_manifold(made.solid).genus() == 0
    assert 0.010 <= made.optics.noise_normal_mm <= 0.015


def test_every_section_of_the_plan_has_its_truth(tmp_path: Path) -> None:
    plan = tomllib.loads(write_recipe(tmp_path, "PASS", 12).read_text())
    sections = part("PASS").truth["sections"]
    assert [section["z_mm"] for section in sections] == plan["sections"]["z_mm"]
    wanted = {"position_x_mm", "position_y_mm", "orientation_deg", "chord_mm", "max_thickness_mm"}
    assert all(wanted <= set(section) for section in sections)


def test_the_recipe_has_a_nominal_that_is_the_blade(tmp_path: Path) -> None:
    plan_path = write_recipe(tmp_path / "blades" / "sim", "demo", 0)
    plan = tomllib.loads(plan_path.read_text())
    nominal = read_solid(plan_path.parent / plan["nominal"])
    assert nominal.volume_mm3 == pytest.approx(nominal_blade(None).airfoil.solid.volume_mm3, rel=1e-6)
    assert plan["airfoil"]["z_min_mm"] == 6.0
    assert plan["airfoil"]["z_max_mm"] == 105.0
    assert set(plan["limits"]["damage"]) == {"tip", "leading_edge", "trailing_edge", "surface"}
    assert plan["measurement"] == {"sigma_mm": 0.015, "coverage_factor": 2.0, "merge_mm": 0.005}


def test_the_true_pose_takes_the_scan_onto_the_nominal() -> None:
    made, rig = part("PASS"), rig_for(12)
    scanner = made.before(rig)
    T_nominal_scan = np.array(made.truth["T_nominal_scan"])
    solid = nominal_blade(None).airfoil.solid
    centres = solid.vertices_mm[solid.faces].mean(axis=1)
    normals = face_normals(solid)[0]
    for angle_deg in (0.0, 120.0, 240.0):
        image = scanner.capture(angle_deg, np.random.default_rng(1))
        seen = image[np.isfinite(image[..., 0])][::50]
        points = apply(T_nominal_scan @ inverse(rig.T_scanner_table0 @ about_z(angle_deg)), seen)
        face = cKDTree(centres).query(points)[1]
        error = np.einsum("ij,ij->i", points - centres[face], normals[face])
        assert np.quantile(np.abs(error), 0.9) < 0.08
        assert np.median(error) == pytest.approx(0.0, abs=0.02)


def test_a_sequence_is_the_same_for_the_same_arguments_and_the_demo_goes_round() -> None:
    again, other = part_for("demo", 12, 0), part_for("demo", 12, 1)
    assert np.array_equal(again.vertices_mm, part("PASS").vertices_mm)
    assert again.truth == part("PASS").truth
    assert (again.preset, other.preset) == ("PASS", "REPAIR")
    assert other.serial != again.serial
    assert not np.array_equal(other.T_table_part, part("REPAIR").T_table_part)


def test_the_wrong_part_fits_nowhere() -> None:
    wrong, right = part("HOLD-wrong-part").solid, nominal_blade(None).airfoil.solid
    assert abs(wrong.volume_mm3 / right.volume_mm3 - 1.0) > 0.05
    spread = [
        np.linalg.svd(s.vertices_mm - s.vertices_mm.mean(axis=0), compute_uv=False) for s in (wrong, right)
    ]
    assert np.abs(np.log(spread[0] / spread[1])).max() > 0.05


def test_an_unknown_preset_is_named() -> None:
    with pytest.raises(ValueError, match="'BROKEN'"):
        make_part(nominal_blade(None), "BROKEN", 0)


def test_presets_are_named_in_any_case() -> None:
    assert [preset_named(text) for text in ("pass", "Hold", "DEMO")] == ["PASS", "HOLD-hole", "demo"]


def finding(value: float) -> Finding:
    return Finding(name="x", value=value, serviceable=1.0, repairable=2.0)


@pytest.mark.parametrize(
    ("values", "stranger", "hidden", "verdict"),
    [
        ((0.5, 1.0), False, False, "PASS"),
        ((0.5, 1.1), False, False, "REPAIR"),
        ((0.5, 2.1), False, False, "SCRAP"),
        ((0.5, 2.1), False, True, "SCRAP"),
        ((0.5, 1.1), False, True, "HOLD"),
        ((0.5, 2.1), True, False, "HOLD"),
    ],
)
def test_the_decision(values: tuple[float, ...], stranger: bool, hidden: bool, verdict: str) -> None:
    assert decide([finding(value) for value in values], stranger=stranger, hidden=hidden) == verdict
