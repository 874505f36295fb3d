"""A plan is read as the contract writes it, or refused with one line that names file, key and fault."""

import pickle
import string
import tomllib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geometry.sections.chart import SectionSettings
from geometry.sections.measurands import section_measurands
from geometry.types import Zone
from station.plans import SECTION_KEYS, BadPlan, BladePlan, check_span, read_plan

PLAN = """\
schema = "bladecell.plan/1"
part_number = "HPC-R3"
revision = "B"
nominal = "nominal.stl"
units = "mm"

[measurement]
sigma_mm = 0.015
coverage_factor = 2.0

[airfoil]
z_min_mm = 0.0
z_max_mm = 105.0

[alignment]
method = "airfoil"
datum_z_mm = [0.0, 20.0]

[sections]
z_mm = [7.0, 52.5, 98.0]

[limits.section]
position_mm = { serviceable = 0.025, repairable = 0.20 }
chord_mm = { serviceable = 0.25, repairable = 1 }

[limits.section."52.50"]
chord_mm = { serviceable = 0.5, repairable = 2.0 }

[limits.form]
deviation_mm = { serviceable = 0.15, repairable = 0.50 }

[limits.damage.tip]
depth_mm = { serviceable = 0.13, repairable = 15.0 }
count = { serviceable = 1, repairable = 2, min_depth_mm = 0.1 }
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "nominal.stl").write_bytes(b"solid")
    return tmp_path


def read(folder: Path, text: str) -> BladePlan:
    (folder / "plan.toml").write_text(text, encoding="utf-8")
    return read_plan(folder / "plan.toml")


def fault(folder: Path, text: str) -> str:
    with pytest.raises(BadPlan) as caught:
        read(folder, text)
    line = str(caught.value)
    assert line.startswith(str(folder / "plan.toml"))
    assert "\n" not in line
    return line.removeprefix(f"{folder / 'plan.toml'}: ")


def test_a_plan_is_read(folder: Path) -> None:
    plan = read(folder, PLAN)
    assert plan.nominal_path == folder / "nominal.stl"
    assert plan.path == folder / "plan.toml"
    assert plan.measurement.sigma_mm == 0.015
    assert plan.scan.angles_deg == tuple(30.0 * i for i in range(12))
    assert (plan.coverage.min_fraction, plan.coverage.max_gap_mm) == (0.95, 1.5)
    assert (plan.zones.tip_mm, plan.zones.edge_mm) == (5.0, 3.0)
    assert plan.limits.of_zone(Zone.TIP).count is not None
    assert not plan.limits.of_zone(Zone.SURFACE)


def test_a_single_section_wins_key_by_key_and_by_number(folder: Path) -> None:
    limits = read(folder, PLAN).limits.section
    assert limits.at(52.5)["chord_mm"].serviceable == 0.5
    assert limits.at(52.5)["position_mm"].serviceable == 0.025
    assert limits.at(7.0)["chord_mm"].serviceable == 0.25


def test_a_plan_crosses_to_another_process(folder: Path) -> None:
    plan = read(folder, PLAN)
    again = pickle.loads(pickle.dumps(plan))
    assert (again, again.path) == (plan, plan.path)


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("position_mm", "positon_mm", "limits.section.positon_mm: unknown key"),
        ("[limits.form]", "colour = 3\n[limits.form]", "limits.section.52.5.colour: unknown key"),
        ('units = "mm"', 'unit = "mm"', "unit: unknown key"),
        ('units = "mm"', 'units = "m"', "units: Input should be 'mm' or 'inch'"),
        ("limits.damage.tip", "limits.damage.root", "limits.damage.root: Input should be"),
        ("bladecell.plan/1", "bladecell.plan/2", "schema: Input should be 'bladecell.plan/1'"),
        (", repairable = 0.20", "", "limits.section.position_mm.repairable: is missing"),
        ("0.20", "0.01", "limits.section.position_mm: limits must be 0 <= serviceable <= repairable"),
        ("0.025", "-0.1", "limits.section.position_mm: limits must be 0 <= serviceable <= repairable"),
        ("0.20", "nan", "limits.section.position_mm.repairable: Input should be a finite number"),
        ("0.20", "inf", "limits.section.position_mm.repairable: Input should be a finite number"),
        ("0.20", '"0.20"', "limits.section.position_mm.repairable: Input should be a valid number"),
        ("0.20", "true", "limits.section.position_mm.repairable: Input should be a valid number"),
        ("sigma_mm = 0.015\n", "", "measurement.sigma_mm: is missing"),
        ("sigma_mm = 0.015", "sigma_mm = 0", "measurement.sigma_mm: Input should be greater than 0"),
        ("z_max_mm = 105.0", "z_max_mm = -1.0", "airfoil: z_max_mm must lie above z_min_mm"),
        ("98.0]", "7.0]", "sections.z_mm: a section stands twice"),
        ("98.0]", "nan]", "sections.z_mm.2: Input should be a finite number"),
        ('"52.50"', '"52.51"', 'limits.section."52.51": no such section in [sections] z_mm'),
        ('"52.50"', '"nan"', "limits.section.nan: unknown key"),
        ('"airfoil"', '"magic"', "alignment.method: Input should be 'airfoil', 'root', 'six_point' or"),
        ("[0.0, 20.0]", "[20.0, 0.0]", "alignment: datum_z_mm must be [lower, upper]"),
        ("nominal.stl", "../nominal.stl", "nominal: '../nominal.stl' lies outside the folder of the plan"),
        ("nominal.stl", "/etc/passwd", "nominal: '/etc/passwd' lies outside the folder of the plan"),
        ("nominal.stl", "other.stl", "nominal: there is no file 'other.stl'"),
        ("nominal.stl", "nom\\u0000inal", "nominal: has characters that cannot be printed"),
        ("HPC-R3", "HPC\\u202e", "part_number: has characters that cannot be printed"),
        ("HPC-R3", "", "part_number: String should have at least 1 character"),
        ("min_depth_mm = 0.1", "min_depth_mm = 0", "limits.damage.tip.count.min_depth_mm: Input should be"),
        ("[measurement]", "[measurement", "is not TOML: "),
    ],
)
def test_what_contradicts_itself_is_refused(folder: Path, old: str, new: str, what: str) -> None:
    assert old in PLAN
    assert fault(folder, PLAN.replace(old, new)).startswith(what)


def test_two_spellings_of_one_section_are_refused(folder: Path) -> None:
    twice = PLAN + '\n[limits.section."5.25e1"]\nchord_mm = { serviceable = 1, repairable = 2 }\n'
    assert fault(folder, twice) == 'limits.section: "5.25e1" stands twice'


@pytest.mark.parametrize(
    ("method", "datum"), [("root", "datum_z_mm"), ("six_point", "points_mm"), ("sections", "z_mm")]
)
def test_each_alignment_needs_its_datum(folder: Path, method: str, datum: str) -> None:
    without = PLAN.replace('"airfoil"', f'"{method}"').replace("datum_z_mm = [0.0, 20.0]\n", "")
    assert fault(folder, without) == f'alignment: method = "{method}" needs {datum}'


def test_six_points_are_six(folder: Path) -> None:
    five = PLAN.replace('"airfoil"', '"six_point"\npoints_mm = [[0,0,0],[1,0,0],[2,0,0],[0,1,0],[0,2,0]]')
    assert fault(folder, five).startswith("alignment.points_mm: Tuple should have at least 6 items")


@pytest.mark.parametrize(
    ("table", "what"),
    [
        ('frames = ["fixture"]', 'repair: frames with "fixture" need T_fixture_scan'),
        ('frames = ["table"]', "repair.frames.0: Input should be 'scan' or 'fixture'"),
        ("T_fixture_scan = [[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]", "repair: T_fixture_scan"),
    ],
)
def test_a_frame_that_is_not_known_is_refused(folder: Path, table: str, what: str) -> None:
    assert fault(folder, f"{PLAN}\n[repair]\n{table}\n").startswith(what)


HEAD = PLAN[: PLAN.index("[limits.section]")]


@pytest.mark.parametrize(
    "limits", ["[limits]", "[limits.section]", "[limits.form]\n[limits.damage.tip]", '[limits.section."7.0"]']
)
def test_a_plan_without_any_limit_is_refused(folder: Path, limits: str) -> None:
    assert fault(folder, f"{HEAD}\n{limits}\n") == "limits: the plan has no limit at all"


def test_section_limits_need_a_section(folder: Path) -> None:
    text = PLAN.replace("z_mm = [7.0, 52.5, 98.0]", "z_mm = []")
    assert fault(folder, text) == "limits.section: no section stands in [sections] z_mm"


@pytest.mark.parametrize(
    ("added", "what"),
    [
        ("[limits.section]\nbend_mm = {}", "limits.section.bend_mm: unknown key"),
        (
            "[limits.section]\nle_thickness_at_3_mm = { serviceable = 1, repairable = 2 }",
            "limits.section.le_thickness_at_3_mm: no such distance in [sections] edge_distances_mm",
        ),
        ("[limits.blade]\nbow = {}", "limits.blade.bow: unknown key"),
        ("[sections.fit]\nlocked = ['z']", "sections.fit.locked.0: Input should be 'x', 'y' or 'rotation'"),
        ("[sections.fit]\nle=0\nsuction=0\nte=0\npressure=0", "sections.fit: all weights are 0"),
    ],
)
def test_a_characteristic_that_no_section_has_is_refused(folder: Path, added: str, what: str) -> None:
    text = PLAN.replace("[limits.section]", added) if added.startswith("[limits.section]") else PLAN + added
    assert fault(folder, text).startswith(what)


def test_every_name_that_can_be_limited_is_measured() -> None:
    names = set(section_measurands(SectionSettings()))
    profiles = {key for key in SECTION_KEYS if key.endswith(("profile_mm", "profile_form_mm"))}
    assert SECTION_KEYS - profiles <= names
    assert {f"{key.removesuffix('_mm')}_max_mm" for key in profiles} <= names


def test_the_example_is_a_plan() -> None:
    path = Path(__file__).parents[2] / "config/blades/example/plan.toml"
    example = BladePlan.model_validate(tomllib.loads(path.read_text()), context={"path": path})
    assert example.sections.edge_distances_mm == (2.0, 4.0)


def test_blade_limits_need_two_sections(folder: Path) -> None:
    one = PLAN.replace("[7.0, 52.5, 98.0]", "[52.5]") + (
        "[limits.blade]\nbow_mm = { serviceable = 1, repairable = 2 }\n"
    )
    assert fault(folder, one) == "limits.blade: fewer than two sections stand in [sections] z_mm"


def test_several_faults_are_counted(folder: Path) -> None:
    assert fault(folder, PLAN.replace("0.20", "nan").replace('"mm"', '"m"')).endswith("(and 1 more)")


def test_a_link_out_of_the_folder_is_refused(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    elsewhere = tmp_path_factory.mktemp("elsewhere") / "nominal.stl"
    elsewhere.write_bytes(b"solid")
    (folder / "linked.stl").symlink_to(elsewhere)
    assert "outside" in fault(folder, PLAN.replace("nominal.stl", "linked.stl"))


@pytest.mark.parametrize(
    ("text", "what"), [(b"\xff\xfe", "is not UTF-8 text"), (b"a" * 1_000_001, "is larger than")]
)
def test_a_file_that_is_no_text_is_refused(folder: Path, text: bytes, what: str) -> None:
    (folder / "plan.toml").write_bytes(text)
    with pytest.raises(BadPlan, match=what):
        read_plan(folder / "plan.toml")


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadPlan, match="No such file"):
        read_plan(tmp_path / "plan.toml")
    with pytest.raises(BadPlan, match="Is a directory"):
        read_plan(tmp_path)


def test_sections_and_airfoil_must_lie_on_the_nominal(folder: Path) -> None:
    plan = read(folder, PLAN)
    check_span(plan, -0.004, 104.996)  # a nominal in float32
    with pytest.raises(BadPlan, match=r"sections.z_mm: 98 mm is outside the nominal's span, 0 to 98 mm"):
        check_span(read(folder, PLAN.replace("z_max_mm = 105.0", "")), 0.0, 98.0)
    with pytest.raises(BadPlan, match=r"airfoil.z_max_mm: 105 mm is outside"):
        check_span(plan, 0.0, 100.0)
    with pytest.raises(BadPlan, match=r"airfoil.z_min_mm: 0 mm is outside"):
        check_span(plan, 6.0, 105.0)
    rooted = read(folder, PLAN.replace('"airfoil"', '"root"').replace("[0.0, 20.0]", "[-9.0, 20.0]"))
    with pytest.raises(BadPlan, match=r"alignment.datum_z_mm: -9 mm is outside"):
        check_span(rooted, 0.0, 105.0)


def read_or_refuse(folder: Path, text: str) -> BladePlan | str:
    try:
        return read(folder, text)
    except BadPlan as error:
        return str(error)


@settings(max_examples=150, deadline=None)
@given(st.integers(0, len(PLAN)), st.text(string.printable, max_size=12), st.integers(0, 12))
def test_any_edit_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, at: int, put: str, cut: int
) -> None:
    folder = tmp_path_factory.getbasetemp()
    (folder / "nominal.stl").write_bytes(b"solid")
    match read_or_refuse(folder, PLAN[:at] + put + PLAN[at + cut :]):
        case BladePlan(limits=limits):
            assert limits
        case line:
            assert "\n" not in line
