"""The transition table against what an operator may rely on."""

import pytest

from station.phases import FAULTED, PACKML, TABLE, State, Trigger, after


def test_every_state_has_its_packml_number_of_tr88() -> None:
    tr88 = {
        "CLEARING": 1,
        "STOPPED": 2,
        "IDLE": 4,
        "SUSPENDED": 5,
        "EXECUTE": 6,
        "STOPPING": 7,
        "ABORTING": 8,
        "ABORTED": 9,
        "BOOT": 9,
        "RESETTING": 15,
        "COMPLETING": 16,
        "COMPLETE": 17,
    }
    assert {state.value: number for state, number in PACKML.items()} == tr88


@pytest.mark.parametrize("state", [s for s in State if s not in (State.BOOT, State.ABORTING, State.ABORTED)])
def test_a_fault_leads_to_aborting_and_only_a_reset_leads_out(state: State) -> None:
    assert after(state, Trigger.FAULT) is State.ABORTING
    ways_out = [trigger for trigger in Trigger if after(State.ABORTED, trigger) is not None]
    assert ways_out == [Trigger.RESET]


@pytest.mark.parametrize("state", list(State))
@pytest.mark.parametrize("trigger", list(Trigger))
def test_what_is_not_in_the_table_is_refused(state: State, trigger: Trigger) -> None:
    expected = TABLE.get((state, trigger))
    assert after(state, trigger) is expected
    if state in FAULTED:
        assert trigger in (Trigger.CHECKED, Trigger.SAFE, Trigger.RESET, Trigger.CLEARED, Trigger.FAULT) or (
            expected is None
        )


def test_a_part_is_measured_only_after_a_request_in_idle() -> None:
    ways_in = {edge for edge, to in TABLE.items() if to is State.EXECUTE}
    assert ways_in == {(State.IDLE, Trigger.REQUEST)}


def test_idle_is_reached_only_from_states_that_are_homed() -> None:
    ways_in = {state for (state, _), to in TABLE.items() if to is State.IDLE}
    assert ways_in == {State.RESETTING, State.SUSPENDED, State.COMPLETE}


def test_a_stop_ends_in_stopped_from_every_running_state() -> None:
    running = [State.RESETTING, State.IDLE, State.SUSPENDED, State.EXECUTE, State.COMPLETING, State.COMPLETE]
    assert all(after(state, Trigger.STOP) is State.STOPPING for state in running)
    assert after(State.STOPPING, Trigger.STOPPED) is State.STOPPED


def test_every_state_can_be_reached_from_boot() -> None:
    reached = {State.BOOT}
    for _ in State:
        reached |= {to for (state, _), to in TABLE.items() if state in reached}
    assert reached == set(State)
