"""The scanner codec against bytes typed from the maker's layouts, and against any bytes at all."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.wire.errors import BadReply
from drivers.wire.scanner import (
    GROUP_CAP,
    NO_DATA,
    Control,
    ControlReply,
    FrameSplitter,
    GroupSplitter,
    Stamp,
    Status,
    decode_control_reply,
    decode_group,
    decode_stamp_block,
    decode_state_block,
    encode_cloud,
    encode_control,
    encode_control_reply,
    encode_stamp,
    encode_surface,
    quantise,
    registers_of,
    restamp,
)

Manual = dict[str, bytes]
STAMP = Stamp(frame_index=7, timestamp_us=1_000_000, scanner_serial=93111)


def test_control_frames_of_the_manual(manual_bytes: Manual) -> None:
    assert encode_control(Control.TRIGGER) == manual_bytes["trigger-command"]
    refused = decode_control_reply(manual_bytes["trigger-while-stopped"])
    assert refused == ControlReply(command=Control.TRIGGER, status=Status.INVALID_STATE)
    version = ControlReply(command=Control.PROTOCOL_VERSION, status=Status.OK, payload=bytes([101, 4]))
    assert decode_control_reply(manual_bytes["version-reply"]) == version
    assert encode_control_reply(version) == manual_bytes["version-reply"]


def test_the_stamp_of_the_manual(manual_bytes: Manual) -> None:
    assert encode_stamp(STAMP) == manual_bytes["stamp"]


def test_the_surface_of_the_manual(manual_bytes: Manual) -> None:
    frame = decode_group(manual_bytes["stamp"] + manual_bytes["surface"])
    assert (frame.frame_index, frame.timestamp_us, frame.scanner_serial) == (7, 1_000_000, 93111)
    seen = [
        (-32.0, -24.0, 0.5),
        (-31.9, -24.0, 1.5),
        (-32.0, -23.9, -0.5),
        (-31.9, -23.9, 33.267),
        (-31.8, -23.9, 0.501),
    ]
    np.testing.assert_allclose(frame.points_mm, seen, rtol=0, atol=1e-12)
    z = np.array([[0, 1000, NO_DATA], [-1000, 32767, 1]], dtype=np.int16)
    again = encode_surface(z, (100_000, 100_000, 1000), (-32_000, -24_000, 500))
    assert again == manual_bytes["surface"]


def test_the_cloud_of_the_manual(manual_bytes: Manual) -> None:
    frame = decode_group(manual_bytes["stamp"] + manual_bytes["cloud"])
    np.testing.assert_allclose(frame.points_mm, [(1.002, -0.998, -0.0015)], rtol=0, atol=1e-12)
    counts = np.array([[[1, 2, -3], [NO_DATA] * 3]], dtype=np.int16)
    assert encode_cloud(counts, (2000, 1000, 500), (1000, -1000, 0)) == manual_bytes["cloud"]


@pytest.mark.parametrize("attributes", [40, 44, 60])
def test_surfaces_of_other_firmware_skip_their_attributes(manual_bytes: Manual, attributes: int) -> None:
    """Attribute sizes 40 and 44 are older, 60 newer than the 52 of the example."""
    body = manual_bytes["surface"][6:]
    grid, data = body[2:54], body[54:]
    body = attributes.to_bytes(2, "little") + (grid + bytes(8))[:attributes] + data
    surface = (6 + len(body)).to_bytes(4, "little") + b"\x08\x80" + body
    frame = decode_group(manual_bytes["stamp"] + surface)
    assert len(frame.points_mm) == 5


def test_other_messages_of_a_group_are_passed_over(manual_bytes: Manual) -> None:
    intensity = bytes.fromhex("08000000 0900 ffff")
    raw = manual_bytes["stamp"] + intensity + manual_bytes["surface"]
    assert len(decode_group(raw).points_mm) == 5


def test_raw_is_kept_verbatim_and_rebuilds_the_frame(manual_bytes: Manual) -> None:
    raw = manual_bytes["stamp"] + manual_bytes["cloud"]
    frame = decode_group(raw)
    assert frame.raw == raw
    assert np.array_equal(decode_group(frame.raw).points_mm, frame.points_mm)


def test_a_restamped_group_differs_in_its_stamp_alone(manual_bytes: Manual) -> None:
    raw = manual_bytes["stamp"] + manual_bytes["cloud"]
    live = Stamp(frame_index=99, timestamp_us=5, scanner_serial=93111)
    again = decode_group(restamp(raw, live))
    assert (again.frame_index, again.timestamp_us) == (99, 5)
    assert np.array_equal(again.points_mm, decode_group(raw).points_mm)
    assert again.raw[len(manual_bytes["stamp"]) :] == manual_bytes["cloud"]


@pytest.mark.parametrize("kind", ["surface", "cloud"])
def test_c6_a_group_cut_anywhere_is_refused(manual_bytes: Manual, kind: str) -> None:
    raw = manual_bytes["stamp"] + manual_bytes[kind]
    for end in range(len(raw)):
        with pytest.raises(BadReply):
            decode_group(raw[:end])
    with pytest.raises(BadReply, match="too many"):
        decode_group(raw + b"\0")


def test_a_group_without_its_parts_is_refused(manual_bytes: Manual) -> None:
    stamp, cloud = manual_bytes["stamp"], manual_bytes["cloud"]
    last_stamp = stamp[:5] + b"\x80" + stamp[6:]
    for raw in (b"", cloud, last_stamp, stamp, stamp + stamp + cloud, cloud + stamp):
        with pytest.raises(BadReply):
            decode_group(raw)


def test_c24_huge_declared_counts_are_refused_before_allocation(manual_bytes: Manual) -> None:
    cloud = bytearray(manual_bytes["cloud"])
    cloud[8:16] = b"\xff" * 8  # rows and columns
    with pytest.raises(BadReply, match="4294967295 x 4294967295"):
        decode_group(manual_bytes["stamp"] + bytes(cloud))
    with pytest.raises(BadReply, match="declares"):
        GroupSplitter().feed((GROUP_CAP + 1).to_bytes(4, "little"))
    with pytest.raises(BadReply, match="declares"):
        GroupSplitter().feed((5).to_bytes(4, "little"))


def test_endless_messages_without_bit_15_reach_the_cap() -> None:
    splitter = GroupSplitter(cap=1000)
    message = (300).to_bytes(4, "little") + b"\x09\x00" + bytes(294)
    assert splitter.feed(3 * message) == []
    with pytest.raises(BadReply, match="group has more"):
        splitter.feed(message)


@given(st.binary(max_size=200))
def test_parsers_are_total(raw: bytes) -> None:
    for parse in (decode_group, decode_control_reply, GroupSplitter().feed, FrameSplitter(1000).feed):
        try:
            parse(raw)
        except BadReply:
            continue


@given(st.data())
def test_a_damaged_group_is_refused_or_still_a_frame(manual_bytes: Manual, data: st.DataObject) -> None:
    raw = bytearray(manual_bytes["stamp"] + manual_bytes["surface"])
    for _ in range(data.draw(st.integers(1, 3))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    try:
        frame = decode_group(bytes(raw))
    except BadReply:
        return
    assert frame.points_mm.shape[1:] == (3,)
    assert np.isfinite(frame.points_mm).all()


def test_groups_come_out_the_same_one_byte_at_a_time(manual_bytes: Manual) -> None:
    groups = [manual_bytes["stamp"] + manual_bytes[kind] for kind in ("surface", "cloud", "surface")]
    stream = b"".join(groups)
    bytewise = GroupSplitter()
    assert GroupSplitter().feed(stream) == groups
    assert [g for at in range(len(stream)) for g in bytewise.feed(stream[at : at + 1])] == groups


@settings(deadline=None)
@given(st.integers(0, 2**32), st.floats(0.01, 60.0))
def test_quantised_points_come_back_within_half_a_step(seed: int, reach_mm: float) -> None:
    rng = np.random.default_rng(seed)
    points_mm = rng.uniform(-reach_mm, reach_mm, (7, 9, 3)) + rng.uniform(-200, 200, 3)
    points_mm[rng.random((7, 9)) < 0.3] = np.nan
    counts, scale_nm, offset_um = quantise(points_mm)
    frame = decode_group(encode_stamp(STAMP) + encode_cloud(counts, scale_nm, offset_um))
    seen = points_mm[np.isfinite(points_mm).all(axis=-1)]
    assert frame.points_mm.shape == seen.shape
    assert np.all(np.abs(frame.points_mm - seen) <= np.array(scale_nm) / 2e6 + 1e-9)
    assert max(scale_nm) <= 2000.0 * reach_mm / 65.0 + 16.0


def test_a_picture_of_nothing_is_a_frame_without_points() -> None:
    blind = quantise(np.full((3, 4, 3), np.nan))
    frame = decode_group(encode_stamp(STAMP) + encode_cloud(*blind))
    assert frame.points_mm.shape == (0, 3)


def test_the_stamp_block_of_modbus() -> None:
    registers = [0] * 16 + [0, 0, 0x000F, 0x4240] + [0, 0, 1, 2]
    block = decode_stamp_block(registers)
    assert (block.timestamp_us, block.frame_index) == (1_000_000, 65_538)
    assert registers_of(65_538, 4) == [0, 0, 1, 2]
    with pytest.raises(BadReply):
        decode_stamp_block(registers[:-1])


def test_the_state_block_of_modbus() -> None:
    state = decode_state_block([1, 0, 0, 0, 0, 0, 0, 0, 0, 0x000F, 0x4240])
    assert (state.running, state.time_us) == (True, 1_000_000)
    assert not decode_state_block([0] * 11).running
    with pytest.raises(BadReply):
        decode_state_block([0] * 10 + [65_536])
