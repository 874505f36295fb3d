"""The codec of the event stream: total, printable, and a round trip for every event."""

from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from station import events
from station.events import (
    BadEvent,
    Event,
    Intent,
    Jog,
    LogLine,
    StationStatus,
    ViewCaptured,
    decode,
    decode_intent,
    encode,
    pack,
    unpack,
)


def _strategy(kind: type) -> st.SearchStrategy[Any]:
    return st.from_type(kind)


st.register_type_strategy(float, st.floats(allow_nan=False, allow_infinity=False))
st.register_type_strategy(str, st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=20))


@given(st.one_of(*(_strategy(kind) for kind in get_args(Event))))
@settings(max_examples=200, deadline=None)
def test_every_event_survives_the_line(event: Event) -> None:
    line = encode(event)
    assert line.endswith(b"\n")
    assert line.count(b"\n") == 1
    assert decode(line) == event


@given(st.one_of(*(_strategy(kind) for kind in get_args(Intent))))
@settings(max_examples=50, deadline=None)
def test_every_intent_survives_the_line(intent: Intent) -> None:
    assert decode_intent(encode(intent)) == intent
    assert isinstance(decode(encode(intent)), BadEvent)


@given(st.binary(max_size=200) | st.text(max_size=100).map(str.encode))
@settings(max_examples=300, deadline=None)
def test_any_bytes_give_a_value(line: bytes) -> None:
    for value in (decode(line), decode_intent(line)):
        if isinstance(value, BadEvent):
            assert value.reason.isascii()
            assert value.reason.isprintable()


@pytest.mark.parametrize(
    "line",
    [
        b"{}",
        b"[]",
        b"null",
        b'{"event": "Nonsense"}',
        b'{"event": ["Start"]}',
        b'{"event": "Jog"}',
        b'{"event": "Jog", "step_deg": NaN}',
        b'{"event": "Jog", "step_deg": 1e999}',
        b'{"event": "Jog", "step_deg": "ten"}',
        b'{"event": "Jog", "step_deg": 1.0, "extra": 1}',
        b'{"event": "Start"}' + b" " * events.MAX_LINE_BYTES,
        b"[" * 100_000,
    ],
)
def test_what_is_no_intent(line: bytes) -> None:
    assert isinstance(decode_intent(line), BadEvent)


@given(st.text(max_size=50))
@settings(max_examples=200, deadline=None)
def test_nothing_reaches_a_screen_that_could_move_its_cursor(text: str) -> None:
    decoded = decode(encode(LogLine(level="info", text=text, at_utc="now")))
    assert isinstance(decoded, LogLine)
    assert len(decoded.text) == len(text)
    assert all(" " <= character <= "~" for character in decoded.text)


def test_numbers_that_are_not_finite_are_not_sent() -> None:
    with pytest.raises(ValueError, match="JSON"):
        encode(Jog(step_deg=float("nan")))


def test_points_survive_as_float32() -> None:
    points = np.random.default_rng(1).normal(0.0, 50.0, (100, 3))
    again = unpack(pack(points), 3)
    assert again.shape == (100, 3)
    assert np.array_equal(again, points.astype(np.float32))
    assert unpack(pack(np.empty((0, 3))), 3).shape == (0, 3)
    for text in ("!!", "AAAA", pack(np.zeros(4))):
        with pytest.raises(ValueError, match=r"base64|rows|multiple|size"):
            unpack(text, 3)


def test_a_view_of_4000_points_fits_a_line() -> None:
    view = ViewCaptured(index=0, total=12, angle_deg=0.0, points=90_000, sample_mm=pack(np.zeros((4000, 3))))
    assert len(encode(view)) < events.MAX_LINE_BYTES


def test_an_unknown_station_state_is_still_shown() -> None:
    status = StationStatus(state="NEW", mode="STUDY", packml=3, station_id="C", version="9")
    assert decode(encode(status)) == status
