"""The alarm engine: latching, first-out, acknowledgement, reset."""

from hypothesis import given, settings
from hypothesis import strategies as st

from station.alarms import (
    KINDS,
    Alarms,
    acknowledged,
    cause_gone,
    changes,
    next_part,
    raised,
    reset,
)

AT = "2026-01-01T00:00:00.000+00:00"


def test_every_kind_says_what_and_what_to_do() -> None:
    for number, kind in KINDS.items():
        assert kind.number == number
        assert kind.text
        assert kind.action
        assert kind.text.isascii()


def test_a_stopping_alarm_stays_until_seen_reset_and_its_cause_gone() -> None:
    alarms = raised(Alarms(), 101, "/dev/ttyS0", AT)
    assert alarms.blocking
    assert reset(acknowledged(alarms), by_person=True)[101] is not None  # the cause is still there
    gone = cause_gone(alarms, 101)
    assert gone[101] is not None
    assert gone[101].state == "RETURNED"
    assert reset(gone, by_person=True)[101] is not None  # nobody has seen it
    seen = acknowledged(gone)
    assert seen[101] is not None
    assert seen[101].state == "LATCHED"
    assert reset(seen, by_person=False) == Alarms()


def test_the_store_needs_a_person() -> None:
    alarms = acknowledged(cause_gone(raised(Alarms(), 2, "EIO", AT), 2))
    assert reset(alarms, by_person=False)[2] is not None
    assert reset(alarms, by_person=True) == Alarms()


def test_only_the_first_cause_of_a_stop_is_first_out() -> None:
    alarms = raised(raised(raised(Alarms(), 124, "", AT), 101, "", AT), 111, "", AT)
    assert [alarm.first_out for alarm in alarms.standing] == [False, True, False]
    again = raised(alarms, 101, "again", AT)
    assert [alarm.first_out for alarm in again.standing] == [False, True, False]


def test_raising_again_makes_it_unseen_again() -> None:
    alarms = raised(acknowledged(raised(Alarms(), 209, "part 1", AT)), 209, "part 2", AT)
    assert [alarm.text for alarm in alarms.standing] == ["ALIGNMENT FAILED OR AMBIGUOUS: part 2"]
    assert alarms.standing[0].state == "UNACK"


def test_a_part_alarm_is_over_when_seen_or_when_the_next_part_comes() -> None:
    alarms = raised(Alarms(), 209, "", AT, lasting=False)
    assert alarms.standing[0].state == "RETURNED"
    assert acknowledged(alarms) == Alarms()
    assert next_part(raised(alarms, 131, "", AT, lasting=False))[131] is not None
    assert next_part(alarms) == Alarms()


def test_advisories_do_not_block() -> None:
    assert not raised(raised(Alarms(), 121, "", AT), 131, "", AT).blocking


STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("raise"), st.sampled_from(sorted(KINDS)), st.booleans()),
        st.tuples(st.just("gone"), st.sampled_from(sorted(KINDS)), st.booleans()),
        st.tuples(st.sampled_from(["ack", "reset", "part"]), st.just(0), st.booleans()),
    ),
    max_size=30,
)


@given(STEPS)
@settings(max_examples=200, deadline=None)
def test_no_way_past_an_active_stop(steps: list[tuple[str, int, bool]]) -> None:
    """Whatever people do, an alarm that stops the cell blocks as long as its cause is present, and after
    that until somebody both saw and reset it."""
    alarms, model = Alarms(), dict[int, tuple[bool, bool]]()
    for what, number, flag in steps:
        before = alarms
        match what:
            case "raise":
                alarms = raised(alarms, number, "", AT, lasting=flag)
                model[number] = (flag, False)
            case "gone":
                alarms = cause_gone(alarms, number)
                model = {n: (a and n != number, s) for n, (a, s) in model.items()}
            case "ack":
                alarms = acknowledged(alarms)
                model = {n: (a, True) for n, (a, s) in model.items()}
            case "reset":
                alarms = reset(alarms, by_person=flag)
                model = {
                    n: (a, s) for n, (a, s) in model.items() if a or not s or (KINDS[n].person and not flag)
                }
            case "part":
                alarms = next_part(alarms)
                model = {n: v for n, v in model.items() if KINDS[n].priority <= 2}
        stops = {n for n in model if KINDS[n].stops}
        assert {alarm.kind.number for alarm in alarms.blocking} == stops
        changed, gone = changes(before, alarms)
        shown = {a.kind.number for a in before.standing} - set(gone) | {a.kind.number for a in changed}
        assert shown == {a.kind.number for a in alarms.standing}
