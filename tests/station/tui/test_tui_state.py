"""The pure step of the screen: what each event changes, and that a lost stream shows no verdict."""

from dataclasses import replace
from functools import reduce

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from station import events
from station.tui.state import ScreenState, lost, step
from tests.station.tui import scenes


def after(sequence: list[events.Event]) -> ScreenState:
    return reduce(lambda state, event: step(event, state), sequence, ScreenState())


def test_nothing_is_live_before_the_snapshot_ends() -> None:
    assert not after(scenes.ready()[:-1]).live
    assert after(scenes.ready()).live


@pytest.mark.parametrize("scene", ["repair", "pass", "scrap", "hold"])
def test_a_lost_stream_shows_no_verdict(scene: str) -> None:
    state = after(scenes.SCENES[scene]())
    assert state.verdict_shown is not None
    assert lost(state).verdict_shown is None


def test_a_new_part_removes_the_old_verdict_cloud_and_sections() -> None:
    state = after([*scenes.SCENES["repair"](), *scenes.scanning(1)[-3:]])
    assert state.verdict_shown is None
    assert state.sections == ()
    assert state.views_done == 1


def test_the_cloud_grows_view_by_view() -> None:
    sizes = [len(after(scenes.scanning(n)).cloud.points_mm) for n in (1, 4, 7)]  # type: ignore[union-attr]
    assert sizes[0] < sizes[1] < sizes[2]


def test_deviations_replace_the_growing_cloud() -> None:
    cloud = after(scenes.SCENES["repair"]()).cloud
    assert cloud is not None
    assert cloud.deviation_mm is not None
    assert len(cloud.deviation_mm) == len(cloud.points_mm)


def test_points_without_their_deviations_are_refused() -> None:
    bad = events.CloudMeasured(
        points_mm=events.pack(np.zeros((5, 3))),
        deviation_mm=events.pack(np.zeros(4)),
        serviceable_mm=0.1,
        repairable_mm=0.2,
    )
    with pytest.raises(ValueError, match="5 points with 4"):
        step(bad, ScreenState())


def test_unacknowledged_alarms_come_first_then_priority() -> None:
    seen = scenes.alarm(102, "ACK")
    minor = replace(scenes.alarm(204), priority=3)
    state = after([seen, minor, scenes.alarm(101)])
    assert [alarm.number for alarm in state.alarms] == [101, 204, 102]
    assert [alarm.number for alarm in step(events.AlarmCleared(number=101), state).alarms] == [204, 102]


def test_the_acknowledgement_reaches_its_record_only() -> None:
    state = after(scenes.SCENES["repair"]())
    answer = events.VerdictAcknowledged(serial="HPC-004417", sequence=1042, record_no=13, code=1)
    assert step(answer, state).records[0].acknowledged
    other = events.VerdictAcknowledged(serial="X", sequence=1, record_no=12, code=1)
    assert not step(other, state).records[0].acknowledged


@given(
    st.lists(st.sampled_from([event for scene in scenes.SCENES.values() for event in scene()]), max_size=30)
)
def test_any_order_of_events_gives_a_state(sequence: list[events.Event]) -> None:
    state = after(sequence)
    assert state.verdict_shown is None or state.live
