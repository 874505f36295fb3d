"""The turntable codec against lines that the maker's own client sends, and against any bytes at all."""

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.wire.errors import BadReply
from drivers.wire.lines import LineSplitter
from drivers.wire.turntable import (
    FLAGS,
    Alert,
    Command,
    Info,
    Reply,
    decode_answer,
    decode_command,
    decode_flags,
    decode_integer,
    encode_command,
    encode_reply,
    with_lrc,
)


def test_commands_of_the_manual_are_encoded_byte_for_byte(manual_lines: dict[str, list[str]]) -> None:
    commands = [
        Command(device=1, axis=1, id=4, words=("home",)),
        Command(device=1, axis=1, id=5),
        Command(device=0, axis=0, id=0),
        Command(device=1, axis=1, id=8, words=("move", "abs", "432000")),
    ]
    assert [encode_command(c).decode() for c in commands] == manual_lines["commands-with-lrc"]
    assert [decode_command(line.encode()) for line in manual_lines["commands-with-lrc"]] == commands


def test_replies_of_the_manual_are_understood(manual_lines: dict[str, list[str]]) -> None:
    busy, rejected, stalled = (decode_answer(line.encode()) for line in manual_lines["replies"])
    assert busy == Reply(device=1, axis=1, id=5, ok=True, busy=True, flag="--", data="0")
    assert rejected == Reply(device=1, axis=1, id=6, ok=False, busy=False, flag="WR", data="BADCOMMAND")
    assert isinstance(stalled, Reply)
    assert decode_flags(stalled.data) == ("FS", "WR")


@pytest.mark.parametrize(
    ("line", "command"),
    [
        (b"/", Command()),
        (b"/home", Command(words=("home",))),
        (b"/1 home", Command(device=1, words=("home",))),
        (b"/1 1 -- stop", Command(device=1, axis=1, silent=True, words=("stop",))),
        (b"noise/1 1 07 get pos", Command(device=1, axis=1, id=7, words=("get", "pos"))),
        (b"/1 1 06 ho/1 1 07 home", Command(device=1, axis=1, id=7, words=("home",))),
        (b"/1 1 05:00", None),
        (b"1 1 05", None),
        (b"/1 1 \xff", None),
        (b"/-- 1", None),
    ],
)
def test_what_a_device_takes_and_what_it_passes_over(line: bytes, command: Command | None) -> None:
    assert decode_command(line) == command


def test_info_and_alert() -> None:
    assert decode_answer(b"#01 1 05 some text") == Info(device=1, axis=1, id=5, text="some text")
    assert decode_answer(b"!01 1 IDLE FS") == Alert(device=1, axis=1, busy=False, flag="FS", data="")


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"@01 1 05 OK BUSY --",
        b"@01 1 05 OK BUSY -- 0:00",
        b"@01 1 05 OK BUSY -- 0 \xb5",
        b"@1 1 05 OK IDLE -- 0",
        b"/1 1 05 get pos",
        b"01 1 05 OK IDLE -- 0",
    ],
)
def test_an_answer_that_breaks_the_grammar_is_a_bad_reply(line: bytes) -> None:
    with pytest.raises(BadReply, match="turntable"):
        decode_answer(line)


@pytest.mark.parametrize("data", ["", "nan", "1,5", "1e999", "1.0", "+1", " 1", "1\n", "٣", "9" * 16])
def test_s23_numbers_are_whole_and_strict(data: str) -> None:
    with pytest.raises(BadReply):
        decode_integer(data)


@pytest.mark.parametrize("data", ["", " ", "x", "02 FS", "1 FS", "00 FS"])
def test_a_list_of_warnings_must_count_itself(data: str) -> None:
    with pytest.raises(BadReply):
        decode_flags(data)


@given(st.binary(max_size=80))
def test_parsers_are_total(line: bytes) -> None:
    decode_command(line)
    with suppress(BadReply):
        decode_answer(line)


@given(st.binary(max_size=80))
def test_a_failure_is_one_printable_line(line: bytes) -> None:
    with pytest.raises(BadReply) as caught:
        decode_answer(b"?" + line)
    assert str(caught.value).isprintable()


replies = st.builds(
    Reply,
    device=st.integers(1, 99),
    axis=st.integers(0, 9),
    id=st.none() | st.integers(0, 99),
    ok=st.booleans(),
    busy=st.booleans(),
    flag=st.sampled_from([*FLAGS, "--"]),
    data=st.from_regex(r"[A-Z0-9-]{1,10}( [A-Z0-9]{1,5})?", fullmatch=True),
    checked=st.booleans(),
)


@given(replies)
def test_what_is_encoded_is_decoded(reply: Reply) -> None:
    assert decode_answer(encode_reply(reply, checksum=reply.checked)) == reply


@given(replies, st.data())
def test_one_flipped_bit_never_passes_with_a_checksum(reply: Reply, data: st.DataObject) -> None:
    """A wrong byte behind the start character is seen, unless it hits the colon and unmakes the LRC."""
    line = bytearray(encode_reply(reply, checksum=True))
    at = data.draw(st.integers(1, len(line) - 1).filter(lambda i: line[i] != ord(":")))
    line[at] ^= 1 << data.draw(st.integers(0, 7))
    try:
        answer = decode_answer(bytes(line))
    except BadReply:
        return
    assert not (isinstance(answer, Reply) and answer.checked and answer.data != reply.data)


@given(st.lists(st.from_regex(r"[ -~]{1,40}", fullmatch=True)), st.sampled_from(["\r", "\n", "\r\n"]))
def test_lines_come_out_the_same_one_byte_at_a_time(texts: list[str], end: str) -> None:
    stream = "".join(text + end for text in texts).encode()
    whole, bytewise = LineSplitter(), LineSplitter()
    want = [text.encode() for text in texts]
    assert whole.feed(stream) == want
    assert [line for at in range(len(stream)) for line in bytewise.feed(stream[at : at + 1])] == want


def test_t11_a_partial_line_is_no_line() -> None:
    """T11: `POS 12` then `.5` must never read as 12."""
    splitter = LineSplitter()
    assert splitter.feed(b"POS 12") == []
    assert splitter.feed(b".5\r\n") == [b"POS 12.5"]


def test_s6_a_flood_without_end_costs_no_memory_and_is_counted() -> None:
    splitter = LineSplitter(cap=256)
    for _ in range(1000):
        assert splitter.feed(b"x" * 1000) == []
    assert splitter.feed(b"\n" + with_lrc("/1 1 05") + b"\n") == [b"/1 1 05:F9"]
    assert splitter.dropped >= 1
