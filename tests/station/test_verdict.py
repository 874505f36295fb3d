"""The decision of the contract, case by case, and what must hold whatever is measured."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geometry.damage.damages import DamageKind
from geometry.sections.blade_line import BladeLine, Judged, RelativeTwist
from geometry.types import Measured, Zone
from station.findings import Finding, Outcome, described, outcome_of
from station.gates import Acceptance, Cause, Gate
from station.measurement import Measurement
from station.plans import Limit
from station.verdict import Verdict, Word, decide, judge
from station.widen import widened
from tests.station.parts import (
    GATES,
    LIMITS,
    ZONES,
    alignment,
    coverage,
    damage,
    lost,
    measurement,
    number,
    patch,
    plan,
    repairs,
    section,
)


def verdict(**changed: Any) -> Verdict:
    return judge(measurement(**changed), plan(), GATES)


def finding(given: Verdict, name: str) -> Finding:
    return next(each for each in given.findings if each.characteristic == name)


# The three zones of a value, sharp at both guard bands.


@pytest.mark.parametrize(
    ("value", "outcome"),
    [
        (0.0, Outcome.PASS),
        (0.75, Outcome.PASS),  # value + U == serviceable is inside
        (0.76, Outcome.HOLD),
        (1.25, Outcome.HOLD),  # value - U == serviceable is not beyond
        (1.26, Outcome.REPAIR),
        (3.75, Outcome.REPAIR),
        (3.76, Outcome.HOLD),
        (4.25, Outcome.HOLD),
        (4.26, Outcome.SCRAP),
    ],
)
def test_a_value_lies_inside_beyond_or_between(value: float, outcome: Outcome) -> None:
    assert outcome_of(value, 0.25, Limit(serviceable=1.0, repairable=4.0)) == outcome


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_what_is_no_number_proves_nothing(bad: float) -> None:
    limit = Limit(serviceable=1.0, repairable=4.0)
    assert outcome_of(bad, 0.1, limit) == outcome_of(0.1, bad, limit) == Outcome.HOLD


def test_a_sound_blade_passes() -> None:
    done = verdict()
    assert (done.verdict, done.route, done.patches) == (Word.PASS, None, ())
    assert {each.outcome for each in done.findings} == {Outcome.PASS}
    assert finding(done, "sections[7.0].chord_mm").deviation == 0.0
    assert finding(done, "damage.tip.depth_mm").U == 0.06  # none found: the detection limit is what is proven
    assert done.reasons == ("all 8 values judged are inside their serviceable limits",)


# Rule 1: the alignment, then the gates.


@pytest.mark.parametrize(
    "bad",
    [
        {"converged": False},
        {"runner_up_ratio": 1.2},
        {"runner_up_ratio": float("nan")},
        {"weak_directions": ((0.0, 0.0, 0.1, 0.0, 0.0, 1.0),)},
        {"explained_fraction": 0.5},
        {"explained_fraction": float("nan")},
        {"T_nominal_scan": np.diag([1.0, 1.0, -1.0, 1.0])},
        {"T_nominal_scan": np.full((4, 4), np.nan)},
    ],
)
def test_an_alignment_that_is_not_accepted_holds_even_scrap(bad: dict[str, Any]) -> None:
    done = verdict(alignment=alignment(**bad), damages=(damage(depth=20.0),), repairs=repairs(patch()))
    assert done.verdict == Word.HOLD
    assert {reason.cause for reason in done.because} == {Cause.ALIGNMENT}
    assert done.patches == ()


def test_without_alignment_the_failure_is_the_reason() -> None:
    done = verdict(alignment=None, failures={"register": "3 scan points are fewer than 200"})
    assert done.reasons == ("alignment: 3 scan points are fewer than 200",)
    assert verdict(alignment=None).reasons == ("alignment: there is none",)


def test_noise_well_above_the_stated_sigma_holds() -> None:
    noisy = alignment(noise_mm=0.05)
    assert verdict(alignment=noisy, residual_mm=None).verdict == Word.HOLD
    assert verdict(alignment=noisy, residual_mm=0.04).verdict == Word.HOLD
    assert verdict(alignment=noisy, residual_mm=float("nan")).verdict == Word.HOLD
    assert verdict(alignment=noisy, residual_mm=0.02).verdict == Word.PASS  # form, not noise


@pytest.mark.parametrize("share", [0.003, 1.0, float("nan")])
def test_a_scan_in_layers_scraps_no_part(share: float) -> None:
    scrap = measurement(damages=(damage(depth=20.0),))
    assert judge(scrap, plan(), GATES).verdict == Word.SCRAP
    done = judge(replace(scrap, layered_fraction=share), plan(), GATES)
    assert done.verdict == Word.HOLD
    assert {reason.cause for reason in done.because} == {Cause.ALIGNMENT}
    fibre = measurement(layered_fraction=0.001)
    assert judge(fibre, plan(), GATES).verdict == Word.PASS


def test_the_noise_of_a_datum_zone_is_not_that_of_the_scan() -> None:
    rough = measurement(alignment=alignment(method="root", noise_mm=0.01), residual_mm=0.05)
    root = plan(alignment={"method": "root", "datum_z_mm": [6.0, 22.0]})
    assert judge(rough, plan(), GATES).verdict == Word.PASS
    assert judge(rough, root, GATES).verdict == Word.HOLD


def test_the_thresholds_of_acceptance_are_settings() -> None:
    loose = Acceptance(min_runner_up_ratio=1.0, min_explained_fraction=0.4, max_noise_ratio=5.0)
    doubtful = measurement(alignment=alignment(runner_up_ratio=1.2, explained_fraction=0.5))
    assert judge(doubtful, plan(), GATES, loose).verdict == Word.PASS


@pytest.mark.parametrize("name", ["calibration", "daily_check", "continuity", "mode"])
def test_an_open_gate_holds(name: str) -> None:
    gates = replace(GATES, **{name: Gate(holds=False, reason="9 days old")})
    done = judge(measurement(damages=(damage(depth=20.0),)), plan(), gates)
    assert done.verdict == Word.HOLD
    assert done.reasons == (f"{name.replace('_', ' ')}: 9 days old",)
    assert done.because[0].cause == Cause.GATE


def test_a_gate_without_a_reason_still_has_a_text() -> None:
    done = judge(measurement(), plan(), replace(GATES, mode=Gate(holds=False)))
    assert done.reasons == ("mode: open",)


# Rule 2: one proof is enough, whatever else is unknown.


def test_one_value_beyond_repair_is_scrap_whatever_is_unmeasured() -> None:
    done = verdict(
        damages=(damage(depth=15.1), damage(Zone.SURFACE, depth=lost("a hole"))),
        repairs=None,
        sections=(),
        zones=(),
        failures={"repair": "no solid"},
    )
    assert done.verdict == Word.SCRAP
    assert done.reasons == ("tip: depth 15.1 mm > repairable 15 mm",)
    assert done.route is None


def test_a_part_of_the_volume_can_prove_scrap() -> None:
    done = verdict(damages=(damage(volume=500.0), damage(volume=lost("no patch"))))
    assert finding(done, "damage.tip.volume_mm3").outcome == Outcome.SCRAP


# Rule 3: what is unseen, unmeasured, unlimited or undecided.


@pytest.mark.parametrize(
    "zones",
    [
        (),
        tuple(coverage(zone, gap_mm=1.6 if zone == Zone.TIP else 0.1) for zone in ZONES),
        tuple(coverage(zone, fraction=0.9 if zone == Zone.TIP else 0.99) for zone in ZONES),
        tuple(coverage(zone, fraction=float("nan")) for zone in ZONES),
        tuple(coverage(zone, gap_mm=float("nan")) for zone in ZONES),
    ],
)
def test_required_surface_that_was_not_seen_holds(zones: Any) -> None:
    done = verdict(zones=zones)
    assert done.verdict == Word.HOLD
    assert done.because[0].cause == Cause.UNSEEN


def test_the_plan_decides_again_what_is_seen() -> None:
    strict = plan(coverage={"min_fraction": 0.999})
    assert judge(measurement(), strict, GATES).verdict == Word.HOLD


def test_a_failed_step_holds() -> None:
    done = verdict(failures={"repair": "out of memory"})
    assert done.reasons == ("repair: out of memory",)
    assert done.because[0].cause == Cause.FAILED_STEP


@pytest.mark.parametrize(
    "sections",
    [(), (section(chord_mm=lost()),), (section(8.0),), (replace(section(), measurands={}),)],
)
def test_a_required_characteristic_that_was_not_measured_holds(sections: Any) -> None:
    done = verdict(sections=sections)
    assert done.verdict == Word.HOLD
    assert finding(done, "sections[7.0].chord_mm").value is None
    assert done.because[0].cause == Cause.NOT_MEASURED


def test_a_nominal_without_the_value_holds() -> None:
    done = verdict(sections=(replace(section(), nominals={}),))
    assert finding(done, "sections[7.0].chord_mm").reason == "the nominal has no such value"
    assert done.verdict == Word.HOLD


def test_in_damage_is_not_judged_where_a_damage_was_found() -> None:
    torn = (section(chord_mm=lost(in_damage=True)),)
    nick = damage(depth=0.2, volume=1.0)
    assert verdict(sections=torn).verdict == Word.HOLD  # no damage that would judge this metal
    done = verdict(sections=torn, damages=(nick,))
    assert finding(done, "sections[7.0].chord_mm").outcome == Outcome.NOT_JUDGED
    assert done.verdict == Word.PASS


@pytest.mark.parametrize(
    "elsewhere",
    [
        damage(Zone.OUTSIDE),
        damage(kind=DamageKind.DEFORMATION, depth=0.0),
        damage(Zone.OUTSIDE, DamageKind.EXCESS),
    ],
)
def test_only_damage_that_limits_judge_excuses_a_section(elsewhere: Any) -> None:
    done = verdict(sections=(section(chord_mm=lost(in_damage=True)),), damages=(elsewhere,))
    assert done.verdict == Word.HOLD


def test_a_damage_in_a_zone_without_a_depth_limit_holds() -> None:
    only_volume = {"damage": {"tip": {"volume_mm3": {"serviceable": 100.0, "repairable": 200.0}}}}
    done = judge(measurement(damages=(damage(),)), plan(only_volume), GATES)
    assert done.verdict == Word.HOLD
    assert done.reasons == ("tip: depth: 1 damage(s) in a zone without a depth limit",)
    assert judge(measurement(), plan(only_volume), GATES).verdict == Word.PASS


def test_a_value_across_its_repairable_limit_holds() -> None:
    done = verdict(form_mm=number("form_mm", 0.5))
    assert done.verdict == Word.HOLD
    assert done.because[0].cause == Cause.UNDECIDED
    assert done.reasons == (
        "form: deviation 0.5 mm +- 0.02 mm is neither inside nor beyond repairable 0.5 mm",
    )


def test_form_that_was_not_measured_holds() -> None:
    assert verdict(form_mm=lost("no twin")).reasons == ("form: deviation: no twin",)


@pytest.mark.parametrize("limit", [number("depth_mm", 0.49, 0.01), lost("too few points"), None])
def test_damage_that_could_be_overlooked_holds(limit: Any) -> None:
    detection = {zone: number("depth_mm", 0.06) for zone in ZONES}
    if limit is None:
        del detection[Zone.SURFACE]
    else:
        detection[Zone.SURFACE] = limit
    done = verdict(detection_mm=detection, damages=(damage(Zone.SURFACE, depth=0.1),))
    assert done.verdict == Word.HOLD
    assert Cause.DETECTION in {reason.cause for reason in done.because}


def test_without_a_detection_limit_no_damage_is_no_proof() -> None:
    done = verdict(detection_mm={zone: lost("no point is sound") for zone in ZONES})
    assert finding(done, "damage.surface.depth_mm").reason == "no detection limit: no point is sound"
    assert finding(verdict(detection_mm={}), "damage.surface.depth_mm").reason == "no detection limit"
    assert done.verdict == Word.HOLD


def test_the_detection_limit_may_reach_the_serviceable_depth_less_its_u() -> None:
    sharp = {zone: number("depth_mm", 0.375, 0.0625) for zone in ZONES}  # 0.375 == 0.5 - 2 * 0.0625
    assert verdict(detection_mm=sharp).verdict == Word.PASS


def test_damage_that_nobody_looked_for_holds() -> None:
    done = verdict(damages=None, detection_mm={})
    assert done.verdict == Word.HOLD
    assert {finding(done, f"damage.tip.{size}").value for size in ("depth_mm", "volume_mm3", "count")} == {
        None
    }


BLADE = {
    "bow_mm": {"serviceable": 0.1, "repairable": 0.5},
    "relative_twist_deg": {"serviceable": 0.2, "repairable": 1.0},
}


def line(bow_mm: float, twists_deg: tuple[Measured | float, ...]) -> BladeLine:
    """A straight blade with this bow and these twists, nominal 0.05 mm and 0."""
    twists = [number("twist_deg", t) if isinstance(t, float) else t for t in twists_deg]
    none = Judged(measured=number("lean_x_deg", 0.0), nominal=0.0)
    return BladeLine(
        lean_x_deg=none,
        lean_y_deg=none,
        bow_mm=Judged(measured=number("bow_mm", bow_mm), nominal=0.05),
        relative_twist=tuple(
            RelativeTwist(z_mm=(i, i + 1.0), twist_deg=Judged(measured=t, nominal=0.0))
            for i, t in enumerate(twists)
        ),
    )


@pytest.mark.parametrize(
    ("given", "word"),
    [
        (line(0.10, (0.1, -0.1)), Word.PASS),
        (line(0.30, (0.1, -0.1)), Word.REPAIR),
        (line(0.10, (0.1, -0.5)), Word.REPAIR),
        (line(0.10, (0.1, -1.5)), Word.SCRAP),
        (line(0.10, (lost(in_damage=True), -1.5)), Word.SCRAP),
        (line(0.10, (lost(in_damage=True), -0.5)), Word.REPAIR),
        (line(0.10, (lost(in_damage=True), 0.1)), Word.PASS),
        (line(0.10, (lost(in_damage=True), lost())), Word.HOLD),
        (line(0.10, (0.15, number("twist_deg", -0.149, 0.2))), Word.HOLD),
        (line(0.10, (number("twist_deg", 1.6, 0.5), -1.5)), Word.SCRAP),
        (None, Word.HOLD),
    ],
)
def test_what_the_sections_say_together_is_judged(given: BladeLine | None, word: Word) -> None:
    limited = plan({**LIMITS, "blade": BLADE}, z_mm=(7.0, 50.0))
    sections = (section(7.0), section(50.0))
    assert judge(measurement(sections=sections, line=given), limited, GATES).verdict == word


def test_any_parameter_of_a_section_can_be_limited() -> None:
    limits = {
        "le_profile_mm": {"serviceable": 0.1, "repairable": 0.5},
        "te_thickness_at_2_mm": {"serviceable": 0.1, "repairable": 0.5},
    }
    measured = {"le_profile_max_mm": 0.05, "le_profile_min_mm": -0.3, "te_thickness_at_2_mm": 1.0}
    given = measurement(sections=(section(**measured),))
    found = {each.characteristic: each for each in judge(given, plan({"section": limits}), GATES).findings}
    assert found["sections[7.0].le_profile_mm"].deviation == -0.3
    assert found["sections[7.0].le_profile_mm"].outcome == Outcome.REPAIR
    assert found["sections[7.0].te_thickness_at_2_mm"].outcome == Outcome.HOLD  # it has no nominal here


@pytest.mark.parametrize(("depth", "word"), [(0.1, Word.PASS), (0.3, Word.REPAIR), (0.9, Word.SCRAP)])
def test_bent_metal_is_judged_by_how_far_it_is_off_the_nominal(depth: float, word: Word) -> None:
    """The twin follows a bend a part of its way: what is left between them is no measure of it."""
    bent = damage(
        kind=DamageKind.DEFORMATION, depth=0.05, volume=999.0, off_nominal=number("off_nominal_mm", depth)
    )
    done = verdict(damages=(bent,))
    assert done.verdict == word
    assert not done.patches


def test_what_merging_leaves_open_is_in_how_far_metal_is_bent() -> None:
    bent = damage(kind=DamageKind.DEFORMATION, off_nominal=number("off_nominal_mm", 0.1, 0.01))
    done = judge(widened(measurement(damages=(bent,)), 0.05), plan(), GATES)
    assert pytest.approx(2.0 * np.hypot(0.01, 0.05)) == finding(done, "form.deviation_mm").U
    assert done.verdict == Word.HOLD


def test_bent_metal_that_could_not_be_measured_holds() -> None:
    bent = damage(kind=DamageKind.DEFORMATION, off_nominal=lost("no point is left"))
    assert verdict(damages=(bent,)).reasons == ("form: deviation: no point is left",)


def test_bent_metal_without_a_limit_of_form_needs_a_limited_section_on_it() -> None:
    bent = damage(kind=DamageKind.DEFORMATION, depth=99.0, volume=999.0)
    for sections, z_mm, word in (
        (True, 100.0, Word.PASS),
        (True, 90.0, Word.HOLD),
        (False, 100.0, Word.HOLD),
    ):
        limits = {key: LIMITS[key] for key in ("damage", *(("section",) if sections else ()))}
        given = measurement(damages=(bent,), sections=(section(z_mm),))
        done = judge(given, plan(limits, z_mm=(z_mm,)), GATES)
        assert done.verdict == word
        if word == Word.HOLD:
            text = "deformation at z 95.0 to 105.0 mm: neither form nor a section there was judged"
            assert text in done.reasons


def test_a_section_without_a_number_judges_no_bent_metal() -> None:
    bent = damage(kind=DamageKind.DEFORMATION, depth=99.0, volume=999.0)
    scratched = section(100.0, chord_mm=lost(in_damage=True))
    given = measurement(damages=(bent, damage(depth=0.2)), sections=(scratched,))
    limits = {key: LIMITS[key] for key in ("damage", "section")}
    assert judge(given, plan(limits, z_mm=(100.0,)), GATES).verdict == Word.HOLD


def test_damage_off_the_airfoil_is_not_judged() -> None:
    assert verdict(damages=(damage(Zone.OUTSIDE, depth=99.0),)).verdict == Word.PASS


# Rule 4: repair.


def test_missing_metal_beyond_serviceable_is_filled() -> None:
    done = verdict(damages=(damage(depth=8.21),), repairs=repairs(patch()))
    assert (done.verdict, done.route, done.patches) == (Word.REPAIR, "fill", (0,))
    assert done.reasons[0] == "tip: depth 8.21 mm > serviceable 0.5 mm"


@pytest.mark.parametrize(
    ("given", "why"),
    [
        (repairs(failures={0: "a hole of 2.1 mm"}), "tip: repair: a hole of 2.1 mm"),
        (repairs(patch(watertight=False)), "tip: repair: there is no valid patch"),
        (repairs(patch(volume_mm3=0.0)), "tip: repair: there is no valid patch"),
        (None, "tip: repair: there is no valid patch"),
    ],
)
def test_without_a_valid_patch_it_is_held(given: Any, why: str) -> None:
    done = verdict(damages=(damage(),), repairs=given)
    assert (done.verdict, done.reasons) == (Word.HOLD, (why,))
    assert done.because[0].cause == Cause.NO_PATCH


def test_a_serviceable_nick_gets_no_patch() -> None:
    nick, broken = damage(Zone.LEADING_EDGE, depth=0.2), damage(depth=8.0)
    both = {"damages": (nick, broken), "repairs": repairs(patch(0), patch(1))}
    assert verdict(**both).patches == (1,)
    assert verdict(damages=(nick,), repairs=repairs(patch(0))).verdict == Word.PASS
    assert verdict(damages=(nick,), repairs=repairs(patch(0))).patches == ()


def test_a_borderline_nick_beside_a_proven_break_needs_a_patch_too() -> None:
    nick, broken = damage(Zone.LEADING_EDGE, depth=0.5), damage(depth=8.0)
    assert verdict(damages=(nick, broken), repairs=repairs(patch(1))).verdict == Word.HOLD
    done = verdict(damages=(nick, broken), repairs=repairs(patch(0), patch(1)))
    assert (done.verdict, done.patches) == (Word.REPAIR, (0, 1))


def test_shallow_nicks_are_filled_when_their_sum_or_number_is_too_large() -> None:
    shallow = damage(depth=0.3, volume=4.0)
    summed = verdict(damages=(shallow, shallow), repairs=repairs(patch(0), patch(1)))
    assert (summed.verdict, summed.patches) == (Word.REPAIR, (0, 1))
    small = damage(depth=0.3, volume=0.5)
    counted = verdict(damages=(small, small), repairs=repairs(patch(0), patch(1)))
    assert counted.reasons == ("tip: count 2 > serviceable 1",)
    assert counted.patches == (0, 1)
    assert verdict(damages=(small,) * 3, repairs=repairs()).verdict == Word.SCRAP


def test_only_damage_proven_deeper_than_the_least_depth_is_counted() -> None:
    scratch = damage(depth=0.07, volume=0.1)  # 0.07 - 2 * 0.01 is not above the detection limit of 0.06
    assert finding(verdict(damages=(scratch,) * 5), "damage.tip.count").value == 0.0
    deeper = {**LIMITS["damage"]["tip"], "count": {"serviceable": 1, "repairable": 2, "min_depth_mm": 0.04}}
    plan_ = plan({"damage": {**LIMITS["damage"], "tip": deeper}})
    done = judge(measurement(damages=(scratch,) * 5), plan_, GATES)
    assert finding(done, "damage.tip.count").value == 5.0
    unknown = damage(depth=lost("no points"), volume=0.1)
    assert finding(verdict(damages=(unknown,)), "damage.tip.count").value == 0.0
    assert verdict(damages=(unknown,)).verdict == Word.HOLD


def test_without_a_detection_limit_damages_are_not_counted() -> None:
    done = verdict(damages=(damage(),), detection_mm={})
    assert finding(done, "damage.tip.count").reason == "no detection limit"
    for size in ("count", "volume_mm3"):  # nor is nothing found a proof of nothing there
        assert finding(verdict(detection_mm={}), f"damage.tip.{size}").outcome == Outcome.HOLD


def test_a_limited_zone_of_which_no_surface_was_required_holds() -> None:
    done = verdict(zones=tuple(coverage(zone) for zone in ZONES if zone != Zone.TIP))
    assert done.verdict == Word.HOLD
    assert done.reasons == ("tip: has limits, but no surface of it is required to be seen",)


def test_what_closes_off_no_volume_on_the_skin_scraps_no_part() -> None:
    fibre = damage(kind=DamageKind.EXCESS, depth=20.0, volume=lost("shows no way out"))
    done = verdict(damages=(fibre,))
    assert done.verdict == Word.HOLD
    assert "tip: depth: its volume: shows no way out" in done.reasons
    bead = damage(kind=DamageKind.EXCESS, depth=20.0, volume=30.0)
    assert verdict(damages=(fibre, bead)).verdict == Word.SCRAP


def test_form_or_excess_alone_is_reworked() -> None:
    form = verdict(form_mm=number("form_mm", 0.3))
    assert (form.verdict, form.route, form.patches) == (Word.REPAIR, "rework", ())
    excess = verdict(damages=(damage(kind=DamageKind.EXCESS, depth=0.9, volume=1.0),))
    assert (excess.verdict, excess.route, excess.patches) == (Word.REPAIR, "rework", ())


def test_the_largest_of_both_profile_deviations_is_judged() -> None:
    limits = {"section": {"profile_mm": {"serviceable": 0.1, "repairable": 0.4}}}
    worn = section(profile_max_mm=0.05, profile_min_mm=-0.2)
    done = judge(measurement(sections=(worn,)), plan(limits), GATES)
    assert finding(done, "sections[7.0].profile_mm").value == -0.2
    assert done.reasons == ("section 7.0: profile 0.2 mm > serviceable 0.1 mm",)
    ends = {"profile_max_mm": number("profile_max_mm", 0.07, 0.01)}
    unsure = section(**ends, profile_min_mm=number("profile_min_mm", -0.06, 0.05))
    done = judge(measurement(sections=(unsure,)), plan(limits), GATES)
    assert (done.verdict, finding(done, "sections[7.0].profile_mm").value) == (Word.HOLD, -0.06)
    half = section(profile_max_mm=0.05, profile_min_mm=lost())
    assert judge(measurement(sections=(half,)), plan(limits), GATES).verdict == Word.HOLD
    bare = replace(section(), measurands={}, reason="no points")
    assert judge(measurement(sections=(bare,)), plan(limits), GATES).reasons == (
        "section 7.0: profile: no points",
    )


def test_the_damage_that_decides_a_zone_is_its_worst() -> None:
    given = (damage(depth=0.2), damage(depth=0.5), damage(depth=9.0), damage(depth=7.0))
    assert finding(verdict(damages=given), "damage.tip.depth_mm").value == 9.0
    unsure = (*given, damage(depth=number("depth_mm", 14.0, 2.0)))
    assert finding(verdict(damages=unsure), "damage.tip.depth_mm").value == 14.0
    assert finding(verdict(damages=(*unsure, damage(depth=16.0))), "damage.tip.depth_mm").value == 16.0
    assert (
        finding(verdict(damages=(damage(depth=0.5), damage(depth=0.1))), "damage.tip.depth_mm").value == 0.5
    )


def test_a_damage_without_a_depth_is_never_left_alone() -> None:
    limits = {"damage": {"tip": {"volume_mm3": {"serviceable": 100.0, "repairable": 200.0}}}}
    done = judge(measurement(damages=(damage(),), repairs=repairs(patch())), plan(limits), GATES)
    assert done.patches == (0,)


def test_a_volume_that_was_not_measured_holds() -> None:
    done = verdict(damages=(damage(depth=0.2, volume=lost("no patch")),))
    assert finding(done, "damage.tip.volume_mm3").reason == "no patch"
    assert done.verdict == Word.HOLD


# Rules 5 and 6.


def test_borderline_is_held() -> None:
    done = verdict(form_mm=number("form_mm", 0.15))
    assert done.verdict == Word.HOLD
    assert done.because[0].cause == Cause.BORDERLINE
    assert "serviceable 0.15 mm" in done.reasons[0]


def test_nothing_judged_is_held() -> None:
    chord_and_depth = {"section": LIMITS["section"], "damage": {"surface": LIMITS["damage"]["surface"]}}
    torn = section(chord_mm=lost(in_damage=True))
    nick = damage(Zone.SURFACE, depth=0.1)
    done = judge(measurement(sections=(torn,), damages=(nick,)), plan(chord_and_depth), GATES)
    assert done.verdict == Word.PASS  # the nick was judged
    off = judge(measurement(sections=(torn,), damages=(nick,)), plan({"section": LIMITS["section"]}), GATES)
    assert off.verdict == Word.HOLD  # nothing judges it


def test_without_any_finding_nothing_is_released() -> None:
    word, because = decide(measurement(), plan(), GATES, Acceptance(), ())
    assert (word, because[0].cause) == (Word.HOLD, Cause.NOTHING_JUDGED)


def test_every_outcome_has_a_sentence() -> None:
    done = verdict()
    assert described(done.findings[0]) == "section 7.0: chord 0 mm <= serviceable 0.25 mm"
    assert described(finding(done, "damage.tip.count")) == "tip: count 0 <= serviceable 1"


# Whatever is measured.

depths = st.floats(0.0, 20.0)
zones_of_damage = st.sampled_from([*ZONES, Zone.OUTSIDE])
kinds = st.sampled_from(list(DamageKind))
sizes = st.one_of(
    st.builds(lambda v, s: number("depth_mm", v, s), depths, st.floats(0.0, 1.0)), st.just(lost("a hole"))
)
damages = st.lists(st.builds(damage, zones_of_damage, kinds, sizes, sizes), max_size=4)
some_patches = st.lists(st.builds(patch, st.integers(0, 3), watertight=st.booleans()), max_size=4)
chords = st.one_of(st.floats(43.0, 47.0), st.just(lost()), st.just(lost(in_damage=True)))


PARTS_OF_A_MEASUREMENT = ["sections", "zones", "damages", "repairs", "detection_mm", "alignment"]


@st.composite
def measurements(draw: st.DrawFn) -> Measurement:
    return measurement(
        damages=draw(st.one_of(st.none(), damages.map(tuple))),
        repairs=draw(st.one_of(st.none(), some_patches.map(lambda given: repairs(*given)))),
        sections=draw(st.one_of(st.just(()), chords.map(lambda c: (section(chord_mm=c),)))),
        form_mm=draw(st.one_of(st.floats(0.0, 1.0).map(lambda v: number("form_mm", v)), st.just(lost()))),
        zones=draw(st.sampled_from([(), *(tuple(coverage(z, gap_mm=g) for z in ZONES) for g in (0.2, 3.0))])),
        detection_mm=draw(st.sampled_from([{}, {z: number("depth_mm", 0.05) for z in ZONES}])),
    )


@settings(max_examples=150, deadline=None)
@given(measurements())
def test_every_word_has_its_proof(given: Measurement) -> None:
    done = judge(given, plan(), GATES)
    outcomes = [each.outcome for each in done.findings]
    assert done.reasons
    assert (done.verdict == Word.SCRAP) == (Outcome.SCRAP in outcomes)
    if done.verdict == Word.PASS:
        assert set(outcomes) <= {Outcome.PASS, Outcome.NOT_JUDGED}
        assert Outcome.PASS in outcomes
        assert given.zones
        assert not given.failures
    if done.verdict == Word.REPAIR:
        assert Outcome.REPAIR in outcomes
        assert all(f.proven_repairable or f.outcome == Outcome.NOT_JUDGED for f in done.findings)


@settings(max_examples=150, deadline=None)
@given(
    measurements(), st.sampled_from(["sections", "zones", "damages", "repairs", "detection_mm", "alignment"])
)
def test_taking_data_away_never_gives_pass_or_repair(given: Measurement, what: str) -> None:
    less: Any = {"sections": (), "zones": (), "detection_mm": {}}.get(what)
    before, after = judge(given, plan(), GATES), judge(replace(given, **{what: less}), plan(), GATES)
    if after.verdict in (Word.PASS, Word.REPAIR):
        assert before.verdict == after.verdict


@settings(max_examples=100, deadline=None)
@given(measurements())
def test_a_failure_more_never_gives_pass_or_repair(given: Measurement) -> None:
    failed = judge(replace(given, failures={"sections": "no plane"}), plan(), GATES)
    assert failed.verdict in (Word.HOLD, Word.SCRAP)


RANK = {Word.PASS: 0, Word.HOLD: 1, Word.REPAIR: 1, Word.SCRAP: 2}


@settings(max_examples=150, deadline=None)
@given(measurements(), st.floats(0.0, 20.0))
def test_deeper_damage_is_never_better(given: Measurement, more_mm: float) -> None:
    def deeper(each: Any) -> Any:
        depth = each.depth_mm
        grown = replace(depth, value=depth.value + more_mm) if hasattr(depth, "value") else depth
        return replace(each, depth_mm=grown)

    worse = replace(given, damages=given.damages and tuple(deeper(d) for d in given.damages))
    assert RANK[judge(worse, plan(), GATES).verdict] >= RANK[judge(given, plan(), GATES).verdict]


@settings(max_examples=100, deadline=None)
@given(measurements(), st.floats(1.0, 5.0))
def test_more_uncertainty_never_proves_more(given: Measurement, factor: float) -> None:
    wider = plan(measurement={"sigma_mm": 0.015, "coverage_factor": 2.0 * factor})
    done, unsure = judge(given, plan(), GATES), judge(given, wider, GATES)
    assert unsure.verdict in (done.verdict, Word.HOLD) or done.verdict == Word.SCRAP


@settings(max_examples=100, deadline=None)
@given(measurements(), st.randoms(use_true_random=False))
def test_the_order_of_sections_and_zones_does_not_matter(given: Measurement, chance: Any) -> None:
    shuffled = replace(given, zones=tuple(chance.sample(given.zones, len(given.zones))))
    assert judge(shuffled, plan(), GATES).verdict == judge(given, plan(), GATES).verdict
