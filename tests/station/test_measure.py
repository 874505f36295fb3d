"""The fold and the order of its steps: a step that lacks its input is skipped, and says so, and nothing is
made up in its place."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from geometry.damage.damages import DamageKind
from geometry.damage.detection import DetectionLimits
from geometry.errors import CannotMeasure
from geometry.scan.calibrate import AxisCalibration
from geometry.scan.overlap import Overlap, RefinedAxis
from geometry.sections.airfoil import SectionStatus
from geometry.types import Cloud, Measurand, NotMeasured, View, Zone
from station import measure
from station.gates import Acceptance
from station.measure import Run, Views, absorb, as_cloud, conclude, measure_cloud
from station.methods import Aligned
from station.recipe import Recipe
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
    tetrahedron,
)

POINTS = np.array([[0.0, 0.0, z] for z in (1.0, 2.0, 3.0, 90.0)])


def ticks() -> Callable[[], float]:
    """A clock that goes on by a second whenever it is read."""
    steps = count()
    return lambda: float(next(steps))


def recipe(**changed: Any) -> Recipe:
    nominal = SimpleNamespace(
        z_max_mm=105.0, closest=lambda points_mm: SimpleNamespace(distance_mm=np.zeros(len(points_mm)))
    )
    fields: dict[str, Any] = {
        "plan": plan(),
        "nominal": nominal,
        "outlines": (),
        "axis": object(),
        "plan_sha256": "",
        "nominal_sha256": "",
    }
    return Recipe(**{**fields, **changed})


def agreed(*overlaps: Overlap, moved_sigmas: float = 0.5, surface_mm: float = 0.0) -> RefinedAxis:
    axis = AxisCalibration(T_scanner_table0=np.eye(4), sigma_offset_mm=0.001, sigma_tilt_deg=0.001)
    return RefinedAxis(axis=axis, moved_sigmas=moved_sigmas, surface_mm=surface_mm, overlaps=overlaps)


@pytest.fixture
def geometry(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What each step of the chain gives; a `CannotMeasure` is raised instead."""
    twin = SimpleNamespace(
        mesh=tetrahedron(), form_mm=number("form_mm", 0.05), noise_mm=0.012, sound=np.ones(4, bool)
    )
    given: dict[str, Any] = {
        "fuse": as_cloud(POINTS, 0.015),
        "refine_axis": agreed(),
        "align": Aligned(alignment=alignment(), service=None),
        "mask_damage": np.zeros(4, bool),
        "make_twin": twin,
        "find_damages": (),
        "detection_limit": DetectionLimits(
            depth_mm=measurement().detection_mm, area_mm2=measurement().detection_mm2
        ),
        "find_repairs": repairs(),
        "cut_sections": (section(),),
        "blade_line": None,
        "measure_coverage": measurement().zones,
    }

    def giving(name: str) -> Callable[..., Any]:
        def step(*_: object, **__: object) -> Any:
            if isinstance(given[name], CannotMeasure):
                raise given[name]
            return given[name]

        return step

    for name in given:
        monkeypatch.setattr(measure, name, giving(name))
    return given


def measured(clock: Callable[[], float] | None = None, **changed: Any) -> Any:
    heard: list[str] = []
    done = measure_cloud(as_cloud(POINTS, 0.015), recipe(**changed), clock or ticks(), heard.append)
    return SimpleNamespace(done=done, heard=heard)


EVERY_STEP = [
    "clean",
    "register",
    "mask",
    "twin",
    "damage",
    "detection",
    "repair",
    "sections",
    "line",
    "coverage",
    "deviation",
]


def test_every_step_is_heard_timed_and_kept(geometry: dict[str, Any]) -> None:
    found = measured()
    assert found.heard == EVERY_STEP
    assert found.done.timing_s == dict.fromkeys(EVERY_STEP, 1.0)
    assert found.done.failures == {}
    assert judge(found.done, plan(), GATES).verdict == Word.PASS


@pytest.mark.parametrize(
    ("broken", "step", "left"),
    [
        ("align", "register", ["clean", "register"]),
        ("mask_damage", "mask", ["clean", "register", "mask", "deviation"]),
        ("make_twin", "twin", [step for step in EVERY_STEP if step not in ("damage", "detection", "repair")]),
        (
            "find_damages",
            "damage",
            [step for step in EVERY_STEP if step != "repair"],
        ),
        ("find_repairs", "repair", EVERY_STEP),
        ("cut_sections", "sections", [step for step in EVERY_STEP if step != "line"]),
        ("measure_coverage", "coverage", EVERY_STEP),
    ],
)
def test_a_step_that_cannot_measure_is_named_and_holds(
    geometry: dict[str, Any], broken: str, step: str, left: list[str]
) -> None:
    geometry[broken] = CannotMeasure("nothing there")
    found = measured()
    assert found.done.failures == {step: "nothing there"}
    assert set(found.heard) <= {*left, "coverage", "deviation"}
    verdict = judge(found.done, plan(), GATES)
    assert verdict.verdict == Word.HOLD
    assert "nothing there" in " ".join(verdict.reasons)


def test_without_registration_there_is_nothing_else(geometry: dict[str, Any]) -> None:
    geometry["align"] = CannotMeasure("too few")
    done = measured().done
    assert (done.alignment, done.damages, done.repairs) == (None, None, None)
    assert (done.zones, done.sections) == ((), ())
    assert isinstance(done.form_mm, NotMeasured)
    assert len(done.aligned_mm) == 0


def test_a_bug_is_not_an_unmeasured_part(geometry: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise IndexError("out of bounds")

    monkeypatch.setattr(measure, "align", broken)
    with pytest.raises(IndexError):
        measured()


# The fold


def views(*indices: int) -> Iterator[View]:
    return (View(index=i, angle_deg=30.0 * i, points_mm=POINTS[: i + 1]) for i in indices)


def test_views_fold_in_plan_order(geometry: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    fused: list[list[int]] = []

    def fuse(given: list[View], axis: object, sigma_mm: float) -> Cloud:
        fused.append([view.index for view in given])
        return as_cloud(POINTS, sigma_mm)

    monkeypatch.setattr(measure, "fuse", fuse)
    state = Views()
    for view in views(2, 0, 1):
        state = absorb(state, view)
    done = conclude(state, recipe(), ticks(), lambda step: None)
    assert fused == [[0, 1, 2]]
    assert done.timing_s["fuse"] == 1.0
    assert judge(done, plan(), GATES).verdict == Word.PASS


def test_what_the_axis_leaves_open_is_in_every_sigma(geometry: dict[str, Any]) -> None:
    exact = conclude(Views(views=tuple(views(0, 1))), recipe(), ticks(), lambda step: None)
    geometry["refine_axis"] = agreed(surface_mm=0.02)
    done = conclude(Views(views=tuple(views(0, 1))), recipe(), ticks(), lambda step: None)
    assert done.merge_mm == 0.02
    check_wider(exact, done)


def test_what_merging_elsewhere_left_open_is_as_the_plan_says(geometry: dict[str, Any]) -> None:
    stated = plan(measurement={"sigma_mm": 0.015, "merge_mm": 0.02})
    exact, done = measured().done, measured(plan=stated).done
    assert (exact.merge_mm, done.merge_mm) == (None, 0.02)
    check_wider(exact, done)


def check_wider(exact: Any, done: Any) -> None:
    """The same values, each sigma with 0.02 mm more: for each end of a chord or a thickness."""
    for before, after in ((exact.form_mm, done.form_mm), *paired(exact.sections[0], done.sections[0])):
        assert isinstance(before, Measurand)
        assert isinstance(after, Measurand)
        assert after.value == before.value
        if after.unit == "mm":
            ends = 2 if after.name in ("chord_mm", "max_thickness_mm") else 1
            assert after.sigma == pytest.approx(np.hypot(before.sigma, ends * 0.02))
        else:
            assert after.sigma > before.sigma


def paired(before: Any, after: Any) -> Iterator[tuple[Any, Any]]:
    for name, measured in before.measurands.items():
        yield measured, after.measurands[name]


def test_views_that_deny_the_calibration_of_the_axis_hold(geometry: dict[str, Any]) -> None:
    geometry["refine_axis"] = agreed(moved_sigmas=9.0)
    done = conclude(Views(views=tuple(views(0, 1))), recipe(), ticks(), lambda step: None)
    assert done.failures == {"fuse": "the views' axis lies 9.0 sigmas off its calibration"}
    assert judge(done, plan(), GATES).verdict == Word.HOLD


def test_a_view_off_the_others_holds(geometry: dict[str, Any]) -> None:
    geometry["refine_axis"] = agreed(Overlap(view=3, points=900, rms_mm=0.09, bias_mm=0.08))
    done = conclude(Views(views=tuple(views(0, 1))), recipe(), ticks(), lambda step: None)
    assert done.failures == {"fuse": "view 3 lies 0.080 mm off the others"}
    assert (done.points, done.alignment) == (3, None)
    assert judge(done, plan(), GATES).verdict == Word.HOLD


def test_views_need_the_axis() -> None:
    with pytest.raises(ValueError, match="axis"):
        conclude(Views(), recipe(axis=None), ticks(), lambda step: None)


# What is settled between the steps


def test_only_a_damage_that_touches_excuses_a_section(geometry: dict[str, Any]) -> None:
    torn = section(7.0, chord_mm=lost("masked", in_damage=True))
    geometry["cut_sections"] = (torn,)
    unexcused = measured().done.sections[0].measurands["chord_mm"]
    assert unexcused == NotMeasured(reason="masked, but no damage was found there")
    geometry["find_damages"] = (replace(damage(Zone.LEADING_EDGE), span_mm=(89.0, 90.0)),)
    assert not measured().done.sections[0].measurands["chord_mm"].in_damage
    geometry["cut_sections"] = (replace(torn, z_mm=90.4),)
    excused = measured().done.sections[0]
    assert excused.measurands["chord_mm"].in_damage
    assert excused.status == SectionStatus.IN_DAMAGE


def test_a_lost_tip_reaches_to_the_end_of_the_span(geometry: dict[str, Any]) -> None:
    geometry["cut_sections"] = (section(103.0, chord_mm=lost()),)
    geometry["find_damages"] = (replace(damage(Zone.TIP), span_mm=(89.0, 90.0)),)
    assert measured().done.sections[0].measurands["chord_mm"].in_damage
    geometry["find_damages"] = (replace(damage(Zone.TIP, DamageKind.EXCESS), span_mm=(89.0, 90.0)),)
    assert not measured().done.sections[0].measurands["chord_mm"].in_damage


def test_a_patch_reaches_beyond_the_points(geometry: dict[str, Any]) -> None:
    geometry["cut_sections"] = (section(1.4, chord_mm=lost()),)
    geometry["find_damages"] = (replace(damage(Zone.SURFACE), span_mm=(3.0, 3.0)),)
    assert not measured().done.sections[0].measurands["chord_mm"].in_damage
    geometry["find_repairs"] = repairs(patch(0))  # from 0 to 1 mm
    assert measured().done.sections[0].measurands["chord_mm"].in_damage


def test_bent_metal_is_measured_by_sections(
    geometry: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    masks: list[list[bool]] = []

    def sections(cloud: Cloud, mask: Any, *_: object) -> Any:
        masks.append(mask.tolist())
        return (section(90.0, chord_mm=lost(in_damage=True)),)

    monkeypatch.setattr(measure, "cut_sections", sections)
    geometry["mask_damage"] = np.array([False, True, True, True])
    geometry["make_twin"].sound = np.array([True, True, False, False])
    bent = replace(damage(kind=DamageKind.DEFORMATION), points=np.array([3]))
    broken = replace(damage(Zone.SURFACE, depth=0.1), points=np.array([0]))
    geometry["find_damages"] = (bent, broken)
    done = measured().done
    # the break is masked, what the twin took back is not, what nothing explains stays, the bend does not
    assert masks == [[True, False, True, False]]
    assert not done.sections[0].measurands["chord_mm"].in_damage


def test_a_damage_has_the_volume_of_its_patch(geometry: dict[str, Any]) -> None:
    own = replace(damage(volume=1.0), points=np.array([3]))
    bare = replace(damage(volume=lost("from its patch")), points=np.array([3]))
    geometry["find_damages"] = (own, bare, bare)
    geometry["find_repairs"] = repairs(patch(1, volume_mm3=61.0))
    first, second, third = (each.volume_mm3 for each in measured().done.damages)
    assert isinstance(first, Measurand)
    assert isinstance(second, Measurand)
    assert (first.value, second.value) == (1.0, 61.0)
    assert third == NotMeasured(reason="from its patch")


def test_a_damage_without_a_patch_says_why(geometry: dict[str, Any]) -> None:
    bare = replace(damage(volume=lost("from its patch")), points=np.array([3]))
    near = replace(damage(volume=1.0), points=np.array([3]))
    geometry["find_damages"] = (bare, near)
    geometry["find_repairs"] = replace(
        repairs(), failures={0: "the surface is open", 1: "the surface is open"}
    )
    first, second = (each.volume_mm3 for each in measured().done.damages)
    assert first == NotMeasured(reason="the surface is open")
    assert isinstance(second, Measurand)


def test_a_run_keeps_time_even_of_what_failed() -> None:
    run = Run(clock=ticks(), progress=lambda step: None)

    def fails() -> None:
        raise CannotMeasure("no")

    assert run.step("a", fails) is None
    assert run.step("b", lambda given: given, None) is None
    assert run.step("c", lambda given, *, optional: (given, optional), 1, optional=None) == (1, None)
    assert (run.failures, run.timing_s) == ({"a": "no"}, {"a": 1.0, "c": 1.0})


def test_noise_is_told_by_the_twin_when_there_is_one(geometry: dict[str, Any]) -> None:
    geometry["align"] = Aligned(alignment=alignment(noise_mm=0.08), service=None)  # the form of a worn blade
    done = measured().done
    assert done.residual_mm == 0.012
    assert judge(done, plan(), GATES, Acceptance()).verdict == Word.PASS
