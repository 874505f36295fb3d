"""Each choice of a plan reaches the verb of that name, with the datum that the plan gives."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from geometry.errors import CannotFitTwin, CannotRegister
from geometry.registration.datums import ServiceMotion
from geometry.sections.chart import SectionSettings
from geometry.transforms import about_z, rigid
from geometry.types import NotMeasured
from station import methods
from station.measure import as_cloud
from station.methods import align, cut_sections, make_twin
from tests.station.parts import alignment, number, plan

CLOUD = as_cloud(np.zeros((3, 3)), 0.01)
POINTS = [[float(i), 0.0, 0.0] for i in range(6)]
MOTION = ServiceMotion(
    **{name: number(name, 0.1) for name in ("bend_x_deg", "bend_y_deg", "twist_deg")},
    **{name: number(name, 0.2) for name in ("tip_x_mm", "tip_y_mm", "tip_z_mm")},
)


def recipe(**tables: Any) -> Any:
    samples = SimpleNamespace(points_mm=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 100.0]]))
    return SimpleNamespace(
        plan=plan(**tables),
        nominal=SimpleNamespace(samples=samples),
        section_settings=SectionSettings(),
    )


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Any]]:
    """The verbs in the order of their calls, each with its last argument."""
    calls: list[tuple[str, Any]] = []

    def verb(name: str, gives: Any) -> Any:
        def call(*arguments: Any) -> Any:
            calls.append((name, arguments[-1]))
            return gives

        return call

    for name in ("register", "register_thesis"):
        monkeypatch.setattr(methods, name, verb(name, alignment()))
    for name in ("register_root", "register_six_point", "register_sections"):
        monkeypatch.setattr(methods, name, verb(name, alignment(method=name)))
    monkeypatch.setattr(methods, "service_motion", verb("service_motion", MOTION))
    for name in ("fit_twin", "fit_twin_thesis"):
        monkeypatch.setattr(methods, name, verb(name, SimpleNamespace(converged=True)))
    for name in ("measure_sections", "measure_sections_thesis"):
        monkeypatch.setattr(methods, name, verb(name, ()))
    return calls


@pytest.mark.parametrize(
    ("choice", "verb", "datum"),
    [
        ({"method": "root", "datum_z_mm": [0.0, 20.0]}, "register_root", (0.0, 20.0)),
        ({"method": "six_point", "points_mm": POINTS}, "register_six_point", POINTS),
        ({"method": "sections", "z_mm": [7.0, 90.0]}, "register_sections", (7.0, 90.0)),
    ],
)
def test_a_part_is_judged_by_the_datum_of_its_plan(
    called: list[tuple[str, Any]], choice: dict[str, Any], verb: str, datum: Any
) -> None:
    assert align(CLOUD, recipe(alignment=choice)).alignment.method == verb
    assert called[1][0] == verb
    np.testing.assert_array_equal(called[1][1], datum)


def test_a_datum_zone_tells_bend_and_twist_beside_any_method(called: list[tuple[str, Any]]) -> None:
    found = align(CLOUD, recipe(alignment={"datum_z_mm": [0.0, 20.0]}))
    assert found.alignment.method == "airfoil"
    assert found.service is MOTION
    assert align(CLOUD, recipe()).service is None


def test_the_root_is_fitted_once(called: list[tuple[str, Any]]) -> None:
    found = align(CLOUD, recipe(alignment={"method": "root", "datum_z_mm": [0.0, 20.0]}))
    assert found.service is MOTION
    assert [name for name, _ in called] == ["register", "register_root", "service_motion"]


@pytest.mark.usefixtures("called")
@pytest.mark.parametrize("weak", [((0.0,) * 6,), None])
def test_a_root_zone_that_is_not_enough_costs_its_numbers_only(
    monkeypatch: pytest.MonkeyPatch, weak: Any
) -> None:
    def root(*_: object) -> Any:
        if weak is None:
            raise CannotRegister("too few points")
        return alignment(weak_directions=weak)

    monkeypatch.setattr(methods, "register_root", root)
    found = align(CLOUD, recipe(alignment={"datum_z_mm": [0.0, 20.0]}))
    assert isinstance(found.service, NotMeasured)
    assert found.alignment.method == "airfoil"


@pytest.mark.parametrize(
    ("table", "verbs"),
    [
        ({}, ["register", "fit_twin", "measure_sections"]),
        (
            dict.fromkeys(("registration", "twin", "sections"), "thesis"),
            ["register", "register_thesis", "fit_twin_thesis", "measure_sections_thesis"],
        ),
    ],
)
def test_each_method_can_be_the_thesis_own(
    called: list[tuple[str, Any]], table: dict[str, str], verbs: list[str]
) -> None:
    wanted, mask = recipe(algorithms=table), np.zeros(3, bool)
    found = align(CLOUD, wanted).alignment
    make_twin(CLOUD, mask, found, wanted)
    cut_sections(CLOUD, mask, found, wanted)
    assert [name for name, _ in called] == verbs


@pytest.mark.parametrize("method", ["default", "thesis"])
def test_a_twin_that_did_not_settle_is_none(monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    for name in ("fit_twin", "fit_twin_thesis"):
        monkeypatch.setattr(methods, name, lambda *_: SimpleNamespace(converged=False))
    with pytest.raises(CannotFitTwin, match="did not converge"):
        make_twin(CLOUD, np.zeros(3, bool), alignment(), recipe(algorithms={"twin": method}))


@pytest.mark.usefixtures("called")
def test_a_pose_of_the_thesis_that_slid_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    slid = rigid(about_z(0.02)[:3, :3], np.array([0.0, 0.0, 0.06]))
    monkeypatch.setattr(methods, "register_thesis", lambda *_: alignment(T_nominal_scan=slid))
    with pytest.raises(CannotRegister, match=r"0\.06 mm off the one that the ends confirm"):
        align(CLOUD, recipe(algorithms={"registration": "thesis"}))
