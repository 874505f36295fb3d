"""The PLC codec against registers typed from the map, another CRC, and any registers at all."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.framer import FramerRTU

from drivers.wire.errors import BadReply
from drivers.wire.plc import (
    PATTERN_VALUES,
    REQUEST_MAP,
    STATION_MAP,
    Ctrl,
    PlcRequest,
    ResultBlock,
    VerdictCode,
    crc16,
    decode_request,
    decode_result,
    encode_request,
)

Manual = dict[str, bytes]
RESULT = ResultBlock(
    sequence=42,
    verdict=VerdictCode.REPAIR,
    worst_deviation_um=-42,
    missing_volume_mm3_x1000=241_366,
    defects=1,
    coverage_percent_x100=10_000,
    serial="SN-0007",
    record_id=17,
    time_ms=1_763_770_000_000,
)


def registers(raw: bytes) -> list[int]:
    return list(struct.unpack(f">{len(raw) // 2}H", raw))


def test_the_crc_is_the_number_itself() -> None:
    assert crc16(b"123456789") == 0x4B37


@given(st.binary(max_size=100))
def test_the_crc_equals_that_of_an_rtu_frame(data: bytes) -> None:
    low_first = FramerRTU.compute_CRC(data)
    assert crc16(data) == (low_first & 0xFF) << 8 | low_first >> 8


def test_the_request_of_the_manual(manual_bytes: Manual) -> None:
    request = decode_request(registers(manual_bytes["request"]))
    assert request.has(Ctrl.ENABLE | Ctrl.PART_PRESENT | Ctrl.START)
    assert not request.has(Ctrl.RESULT_ACK)
    assert (request.heartbeat, request.epoch, request.sequence, request.recipe) == (3, 1, 42, 1)
    assert request.serial == "SN-0007"
    assert request.crc == 0x4766
    assert request.crc_ok(accept_zero=False)
    assert encode_request(request) == registers(manual_bytes["request"])


def test_the_result_of_the_manual(manual_bytes: Manual) -> None:
    assert list(RESULT.encode()) == registers(manual_bytes["result"])
    assert decode_result(registers(manual_bytes["result"])) == RESULT


@pytest.mark.parametrize("table", [REQUEST_MAP, STATION_MAP])
def test_registers_do_not_overlap(table: tuple[object, ...]) -> None:
    taken = [at for row in table for at in range(row.address, row.address + row.count)]  # type: ignore[attr-defined]
    assert len(taken) == len(set(taken))


def test_the_pattern_shows_byte_and_word_order() -> None:
    assert PATTERN_VALUES == (0x1234, 0x1234, 0x5678, 0x4142)


@pytest.mark.parametrize("at", [*range(3, 7), *range(11, 28)])
def test_every_register_under_the_request_crc_counts(manual_bytes: Manual, at: int) -> None:
    values = registers(manual_bytes["request"])
    values[at] ^= 1
    assert not decode_request(values).crc_ok(accept_zero=True)


def test_a_plc_that_cannot_compute_the_crc_is_taken_only_if_allowed(manual_bytes: Manual) -> None:
    values = registers(manual_bytes["request"])
    values[28] = 0
    assert decode_request(values).crc_ok(accept_zero=True)
    assert not decode_request(values).crc_ok(accept_zero=False)


def with_serial(text: bytes, length: int) -> PlcRequest:
    raw = bytes(22) + struct.pack(">H32s", length, text) + bytes(2)
    return decode_request(registers(raw))


@pytest.mark.parametrize(
    ("text", "length"),
    [
        (b"", 0),
        (b"SN", 0),
        (b"SN", 3),
        (b"SN1", 2),
        (b"SN\x00X", 2),
        (b"sn", 2),
        (b"SN 1", 4),
        (b"../ETC", 6),
        (b"SN[/", 4),
        (b"\x1b[2J", 4),
        (b"S\x00N", 3),
        (b"SN\n", 3),
        (b"A" * 32, 33),
        (b"A" * 32, 65535),
    ],
)
def test_p22_a_serial_of_other_making_is_none(text: bytes, length: int) -> None:
    assert with_serial(text, length).serial is None


@pytest.mark.parametrize("serial", ["A", "SN-0007", "Z" * 32, "0-9"])
def test_a_serial_of_the_contract_is_itself(serial: str) -> None:
    assert with_serial(serial.encode(), len(serial)).serial == serial


@pytest.mark.parametrize("at", range(36))
def test_every_register_of_a_result_is_guarded(manual_bytes: Manual, at: int) -> None:
    values = registers(manual_bytes["result"])
    values[at] ^= 0x0101
    with pytest.raises(BadReply, match="result block"):
        decode_result(values)


def test_no_result_stands_in_zeros() -> None:
    """The fail-safe value of every register is none."""
    with pytest.raises(BadReply):
        decode_result([0] * 36)


@pytest.mark.parametrize(
    "change",
    [
        {"verdict": VerdictCode.NONE},
        {"serial": ""},
        {"serial": "sn"},
        {"sequence": 2**32},
        {"worst_deviation_um": 2**31},
        {"record_id": -1},
    ],
)
def test_a_result_that_does_not_fit_its_registers_is_not_made(change: dict[str, object]) -> None:
    fields = {name: getattr(RESULT, name) for name in ResultBlock.__slots__} | change
    with pytest.raises(ValueError, match="result"):
        ResultBlock(**fields)


words = st.integers(0, 0xFFFF)


@given(st.lists(words, min_size=29, max_size=29))
def test_any_29_registers_are_a_request(values: list[int]) -> None:
    request = decode_request(values)
    assert request.serial is None or 1 <= len(request.serial) <= 32


@given(st.lists(words, max_size=40))
def test_any_registers_are_a_result_or_a_bad_reply(values: list[int]) -> None:
    try:
        block = decode_result(values)
    except BadReply:
        return
    assert list(block.encode()) == values


def test_other_counts_are_refused() -> None:
    for values in ([], [0] * 28, [0] * 30, [0] * 28 + [65536], [0] * 28 + [-1]):
        with pytest.raises(BadReply):
            decode_request(values)
