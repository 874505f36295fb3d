"""STEP and IGES nominals, against the closed form that the CAD kernel lofted them from.

`data/blade_mm.step` and `data/blade_inch.igs` are one solid, written by OpenCASCADE 8 in millimetres and in
inches: four sections, 4 mm apart and each 3 degrees further round, of the curve below, lofted.
"""

from pathlib import Path

import numpy as np
import pytest

from geometry.blade.nominal import NominalSettings, prepare_nominal
from geometry.errors import BadMesh
from geometry.types import Floats, Mesh
from station.formats import cad
from station.formats.cad import is_cad, read_cad
from station.plans import BadPlan, read_plan
from station.recipe import prepare_recipe

DATA = Path(__file__).parent / "data"
FILES = ("blade_mm.step", "blade_inch.igs")
HEIGHT_MM, TWIST_DEG = 12.0, 9.0
AREA_MM2 = np.pi * 3.0 * 0.9  # of the curve, by Green's theorem

PLAN = """
schema = "bladecell.plan/1"
part_number = "CAD"
revision = "A"
nominal = "{nominal}"
units = "mm"
[measurement]
sigma_mm = 0.01
coverage_factor = 2.0
[sections]
z_mm = [6.0]
[limits.section]
chord_mm = {{ serviceable = 0.1, repairable = 1.0 }}
"""


def curve_mm(z_mm: float) -> Floats:
    t = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
    x, y = 3.0 * np.cos(t), 0.9 * np.sin(t) + 0.5 * np.cos(t) ** 2
    turn = np.deg2rad(TWIST_DEG * z_mm / HEIGHT_MM)
    return np.column_stack(
        [x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn), np.full(len(t), z_mm)]
    )


def volume_mm3(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices_mm[mesh.faces], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6.0


@pytest.mark.parametrize("name", FILES)
def test_a_cad_file_is_the_solid_that_was_drawn_whatever_its_unit(name: str) -> None:
    mesh = read_cad(DATA / name)
    assert volume_mm3(mesh) == pytest.approx(
        AREA_MM2 * HEIGHT_MM, rel=1e-3
    )  # facets inside the curve take 0.7e-3
    nominal = prepare_nominal(mesh, NominalSettings())
    for z_mm in (4.0, 8.0):
        assert np.abs(nominal.closest(curve_mm(z_mm)).distance_mm).max() < 0.003


def test_a_plan_takes_a_cad_file_for_its_nominal(tmp_path: Path) -> None:
    (tmp_path / "blade.stp").write_bytes((DATA / "blade_mm.step").read_bytes())
    (tmp_path / "plan.toml").write_text(PLAN.format(nominal="blade.stp"))
    recipe = prepare_recipe(read_plan(tmp_path / "plan.toml"))
    assert recipe.nominal.tip_z_mm == pytest.approx(HEIGHT_MM, abs=0.001)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9])
def test_a_truncated_file_is_one_line(tmp_path: Path, name: str, kept: float) -> None:
    whole = (DATA / name).read_bytes()
    path = tmp_path / name
    path.write_bytes(whole[: int(kept * len(whole))])
    with pytest.raises(BadMesh) as refused:
        read_cad(path)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_what_the_kernel_says_stays_off_the_terminal(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.step").write_bytes(b"no STEP file")
    with pytest.raises(BadMesh, match="holds no solid that can be read as STEP"):
        read_cad(tmp_path / "a.step")
    assert capfd.readouterr() == ("", "")


def test_without_the_extra_the_line_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cad, "find_spec", lambda name: None)
    (tmp_path / "blade.iges").write_bytes(b"")
    (tmp_path / "plan.toml").write_text(PLAN.format(nominal="blade.iges"))
    with pytest.raises(BadPlan, match=r"bladecell\[cad\]"):
        prepare_recipe(read_plan(tmp_path / "plan.toml"))


def test_endings_are_known_in_any_case() -> None:
    assert all(is_cad(Path(f"a{ending}")) for ending in (".step", ".STP", ".iges", ".IGS"))
    assert not is_cad(Path("a.stl"))
