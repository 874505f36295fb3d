"""Gocator protocol: control frames, GDP messages and the Modbus table. Little-endian on both channels.

A frame starts with its own length (32 bits, itself included) and a 16-bit word. On the control channel
that word is the command; on the data channel it is the message type, and bit 15 marks the last message
of a group. One group is one capture: a stamp (type 1) and surfaces (type 8, 28). See docs/wire/scanner.md.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from drivers.wire.errors import BadReply

Floats = NDArray[np.float64]

GROUP_CAP = 256 * 1024 * 1024
CONTROL_CAP = 64 * 1024
LAST_OF_GROUP = 0x8000
NO_DATA = -32768
PROTOCOL_MAJOR = 101

_HEAD = struct.Struct("<IH")
_REPLY = struct.Struct("<IHi")
_STAMPS = struct.Struct("<IHBB")
_STAMP = struct.Struct("<QQqqQIIQ")
_GRID = struct.Struct(
    "<5I3iBI"
)  # rows, columns, three scales in nm, three offsets in um, source, exposure in ns


class Control(IntEnum):
    """Commands of the control channel."""

    PROTOCOL_VERSION = 0x4511
    STATES = 0x4525
    START = 0x100D
    STOP = 0x1001
    TRIGGER = 0x4510
    TIMESTAMP = 0x100A
    PING = 0x100E


class Status(IntEnum):
    """Outcome of a control command."""

    OK = 1
    FAILED = 0
    INVALID_PARAMETER = -997
    INVALID_COMMAND = -998
    INVALID_STATE = -1000


class MessageType(IntEnum):
    """Types of GDP message that are read; others in a group are passed over."""

    STAMP = 1
    UNIFORM_SURFACE = 8
    POINT_CLOUD = 28


# Modbus, 0-based; 64-bit values high word first (docs/wire/scanner.md).
COMMAND = 0
COMMAND_COUNT = 65
SENSOR_STATE, STATE_BLOCK_COUNT = 300, 11
TIME_NOW = 307
BUFFER_ADVANCE = 976
STAMP_BLOCK, STAMP_BLOCK_COUNT = 976, 24
FRAME_TIME = 992
FRAME_INDEX = 996
READABLE = (range(300, 372), range(375, 383), range(960, 1060))


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlReply:
    """What the sensor answered to a control command."""

    command: int
    status: int
    payload: bytes = b""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stamp:
    """When and by whom a frame was taken."""

    frame_index: int
    timestamp_us: int
    scanner_serial: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RangeFrame:
    """One capture: its stamp, the valid points (n, 3) in the scanner frame, and the group as it came."""

    frame_index: int
    timestamp_us: int
    scanner_serial: int
    points_mm: Floats
    raw: bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class StampBlock:
    """Registers 976-999: the sensor's own word on its last frame."""

    frame_index: int
    timestamp_us: int


@dataclass(frozen=True, slots=True, kw_only=True)
class StateBlock:
    """Registers 300-310: whether the sensor runs, and its clock."""

    running: bool
    time_us: int


@dataclass(slots=True)
class FrameSplitter:
    """Cuts a byte stream into length-prefixed frames; a length outside 6..`cap` raises `BadReply`."""

    cap: int
    _buffer: bytearray = field(default_factory=bytearray)

    def feed(self, data: bytes) -> list[bytes]:
        """The frames completed by `data`, heads included."""
        self._buffer += data
        frames = []
        while len(self._buffer) >= 4:
            length = int.from_bytes(self._buffer[:4], "little")
            if not _HEAD.size <= length <= self.cap:
                raise _bad(f"a frame declares {length} bytes, want {_HEAD.size}..{self.cap}")
            if len(self._buffer) < length:
                break
            frames.append(bytes(self._buffer[:length]))
            del self._buffer[:length]
        return frames


@dataclass(slots=True)
class GroupSplitter:
    """Cuts the data channel into whole groups, each up to and with the message that carries bit 15."""

    cap: int = GROUP_CAP
    _frames: FrameSplitter = field(init=False)
    _open: list[bytes] = field(default_factory=list)
    _size: int = 0

    def __post_init__(self) -> None:
        self._frames = FrameSplitter(self.cap)

    def feed(self, data: bytes) -> list[bytes]:
        """The groups completed by `data`; raises `BadReply` for a group over the cap."""
        groups = []
        for frame in self._frames.feed(data):
            self._open.append(frame)
            self._size += len(frame)
            if self._size > self.cap:
                raise _bad(f"a group has more than {self.cap} bytes")
            if _HEAD.unpack_from(frame)[1] & LAST_OF_GROUP:
                groups.append(b"".join(self._open))
                self._open.clear()
                self._size = 0
        return groups


def encode_control(command: int, payload: bytes = b"") -> bytes:
    """A command frame."""
    return _HEAD.pack(_HEAD.size + len(payload), command) + payload


def decode_control(frame: bytes) -> tuple[int, bytes]:
    """Command and payload of a frame; raises `BadReply` for a frame that is not what its length says."""
    if len(frame) < _HEAD.size or _HEAD.unpack_from(frame)[0] != len(frame):
        raise _bad(f"a command of {len(frame)} bytes contradicts its length")
    return _HEAD.unpack_from(frame)[1], frame[_HEAD.size :]


def encode_control_reply(reply: ControlReply) -> bytes:
    """A reply frame."""
    return _REPLY.pack(_REPLY.size + len(reply.payload), reply.command, reply.status) + reply.payload


def decode_control_reply(frame: bytes) -> ControlReply:
    """The reply in a frame."""
    if len(frame) < _REPLY.size or _REPLY.unpack_from(frame)[0] != len(frame):
        raise _bad(f"a reply of {len(frame)} bytes is too short or contradicts its length")
    _, command, status = _REPLY.unpack_from(frame)
    return ControlReply(command=command, status=status, payload=frame[_REPLY.size :])


def encode_stamp(stamp: Stamp, *, last: bool = False) -> bytes:
    """A type 1 message with one stamp."""
    body = _STAMPS.pack(1, _STAMP.size, 0, 0) + _pack_stamp(stamp)
    return _message(MessageType.STAMP, body, last=last)


def encode_surface(
    z: NDArray[np.int16],
    scale_nm: tuple[int, int, int],
    offset_um: tuple[int, int, int],
    *,
    last: bool = True,
) -> bytes:
    """A type 8 message: z (rows, columns) in counts, `NO_DATA` where nothing was seen; 52 attribute bytes."""
    grid = _GRID.pack(*z.shape, *scale_nm, *offset_um, 0, 8_000_000)
    attributes = grid + bytes(7) + struct.pack("<ii", 3, 0)
    return _surface_message(MessageType.UNIFORM_SURFACE, attributes, z, last=last)


def encode_cloud(
    counts: NDArray[np.int16],
    scale_nm: tuple[int, int, int],
    offset_um: tuple[int, int, int],
    *,
    last: bool = True,
) -> bytes:
    """A type 28 message: x, y, z (rows, columns, 3) in counts, all `NO_DATA` where nothing was seen."""
    rows, columns, _ = counts.shape
    grid = _GRID.pack(rows, columns, *scale_nm, *offset_um, 0, 8_000_000)
    attributes = grid + struct.pack("<Bii", 1, 3, 0)
    return _surface_message(MessageType.POINT_CLOUD, attributes, counts, last=last)


def quantise(points_mm: Floats) -> tuple[NDArray[np.int16], tuple[int, int, int], tuple[int, int, int]]:
    """Counts, scales in nm and offsets in um that hold points (rows, columns, 3); NaN where nothing was seen.

    The finest whole-nanometre step that spans the seen points in each axis: rounding error is at most half
    of it.
    """
    seen = np.isfinite(points_mm).all(axis=-1)
    span_mm = points_mm[seen] if seen.any() else np.zeros((1, 3))
    low_mm, high_mm = span_mm.min(axis=0), span_mm.max(axis=0)
    offset_um = np.round((low_mm + high_mm) * 500.0).astype(np.int64)
    reach_mm = np.maximum(high_mm - offset_um / 1000.0, offset_um / 1000.0 - low_mm)
    scale_nm = np.maximum(np.ceil(reach_mm * 1e6 / 32766.0), 1.0).astype(np.int64)
    counts = np.full(points_mm.shape, NO_DATA, dtype=np.int16)
    exact = (points_mm[seen] - offset_um / 1000.0) * (1e6 / scale_nm)
    counts[seen] = np.round(exact).astype(np.int16)
    return counts, _triple(scale_nm), _triple(offset_um)


def decode_group(raw: bytes) -> RangeFrame:
    """The capture in a whole group: exactly one stamp, at least one surface, bit 15 on the last message only.

    Raises `BadReply` for anything else. Sizes are checked against each other before an array is made.
    """
    stamp: Stamp | None = None
    surfaces: list[Floats] = []
    for kind, body in _messages(raw):
        if kind == MessageType.STAMP:
            if stamp is not None:
                raise _bad("a group has two stamps")
            stamp = _decode_stamp(body)
        elif kind == MessageType.UNIFORM_SURFACE:
            surfaces.append(_decode_surface(body))
        elif kind == MessageType.POINT_CLOUD:
            surfaces.append(_decode_cloud(body))
    if stamp is None or not surfaces:
        raise _bad("a group lacks its stamp or its surface")
    return RangeFrame(
        frame_index=stamp.frame_index,
        timestamp_us=stamp.timestamp_us,
        scanner_serial=stamp.scanner_serial,
        points_mm=np.concatenate(surfaces),
        raw=raw,
    )


def restamp(raw: bytes, stamp: Stamp) -> bytes:
    """The same group with another stamp; every other byte stays as it was."""
    start = 0
    for kind, body in _messages(raw):
        start += _HEAD.size
        if kind == MessageType.STAMP:
            _decode_stamp(body)
            at = start + _STAMPS.size
            return raw[:at] + _pack_stamp(stamp) + raw[at + _STAMP.size :]
        start += len(body)
    raise _bad("a group lacks its stamp")


def decode_stamp_block(registers: list[int]) -> StampBlock:
    """The stamp in registers 976-999."""
    raw = _register_bytes(registers, STAMP_BLOCK_COUNT)
    timestamp_us, frame_index = struct.unpack_from(">QQ", raw, 2 * (FRAME_TIME - STAMP_BLOCK))
    return StampBlock(frame_index=frame_index, timestamp_us=timestamp_us)


def decode_state_block(registers: list[int]) -> StateBlock:
    """State and clock in registers 300-310."""
    raw = _register_bytes(registers, STATE_BLOCK_COUNT)
    (time_us,) = struct.unpack_from(">Q", raw, 2 * (TIME_NOW - SENSOR_STATE))
    return StateBlock(running=registers[0] == 1, time_us=time_us)


def registers_of(value: int, count: int) -> list[int]:
    """An unsigned number in `count` registers, high word first."""
    return list(struct.unpack(f">{count}H", value.to_bytes(2 * count, "big")))


def _messages(raw: bytes) -> Iterator[tuple[int, memoryview]]:
    """Type and body of each message; raises `BadReply` unless they fill the bytes and end with bit 15."""
    view = memoryview(raw)
    at, last = 0, False
    while at < len(raw):
        if last or len(raw) - at < _HEAD.size:
            raise _bad(f"{len(raw) - at} bytes too many at the end of a group")
        size, control = _HEAD.unpack_from(raw, at)
        if not _HEAD.size <= size <= len(raw) - at:
            raise _bad(f"a message declares {size} bytes where {len(raw) - at} are left")
        yield control & ~LAST_OF_GROUP, view[at + _HEAD.size : at + size]
        at, last = at + size, bool(control & LAST_OF_GROUP)
    if not last:
        raise _bad("a group ends without its last message")


def _decode_stamp(body: memoryview) -> Stamp:
    if len(body) < _STAMPS.size:
        raise _bad(f"a stamp message of {len(body)} bytes is too short")
    count, size, _, _ = _STAMPS.unpack_from(body)
    if count != 1 or size != _STAMP.size or len(body) != _STAMPS.size + size:
        raise _bad(f"{count} stamps of {size} bytes in {len(body)}, want one of {_STAMP.size}")
    index, timestamp_us, _, _, _, serial, _, _ = _STAMP.unpack_from(body, _STAMPS.size)
    return Stamp(frame_index=index, timestamp_us=timestamp_us, scanner_serial=serial)


def _decode_surface(body: memoryview) -> Floats:
    """The seen points of a height map: x by column, y by row."""
    z, (scale_nm, offset_um) = _decode_grid(body, least_attributes=40, channels=1)
    rows, columns = np.nonzero(z[..., 0] != NO_DATA)
    counts = np.column_stack([columns, rows, z[rows, columns, 0]])
    points_mm: Floats = offset_um / 1000.0 + counts * (scale_nm / 1e6)
    return points_mm


def _decode_cloud(body: memoryview) -> Floats:
    """The seen points of a point cloud."""
    counts, (scale_nm, offset_um) = _decode_grid(body, least_attributes=46, channels=3)
    points_mm: Floats = offset_um / 1000.0 + counts[counts[..., 2] != NO_DATA] * (scale_nm / 1e6)
    return points_mm


def _decode_grid(
    body: memoryview, *, least_attributes: int, channels: int
) -> tuple[NDArray[np.int16], tuple[Floats, Floats]]:
    """Counts (rows, columns, channels), scales in nm and offsets in um."""
    attributes = int.from_bytes(body[:2], "little")
    if not least_attributes <= attributes <= len(body) - 2:
        raise _bad(f"a surface of {len(body)} bytes declares {attributes} attribute bytes")
    rows, columns, *rest = _GRID.unpack_from(body, 2)
    if 2 + attributes + 2 * channels * rows * columns != len(body):
        raise _bad(f"a surface of {rows} x {columns} cells does not fit its {len(body)} bytes")
    counts = np.frombuffer(body, dtype="<i2", offset=2 + attributes).reshape(rows, columns, channels)
    return counts, (np.array(rest[:3], dtype=np.float64), np.array(rest[3:6], dtype=np.float64))


def _surface_message(kind: MessageType, attributes: bytes, counts: NDArray[np.int16], *, last: bool) -> bytes:
    body = struct.pack("<H", len(attributes)) + attributes + counts.astype("<i2").tobytes()
    return _message(kind, body, last=last)


def _message(kind: MessageType, body: bytes, *, last: bool) -> bytes:
    return _HEAD.pack(_HEAD.size + len(body), kind | (LAST_OF_GROUP if last else 0)) + body


def _register_bytes(registers: list[int], count: int) -> bytes:
    if len(registers) != count or not all(0 <= value <= 0xFFFF for value in registers):
        raise _bad(f"{len(registers)} registers, want {count} of 16 bits")
    return struct.pack(f">{count}H", *registers)


def _pack_stamp(stamp: Stamp) -> bytes:
    return _STAMP.pack(stamp.frame_index, stamp.timestamp_us, 0, 0, 0, stamp.scanner_serial, 0, 0)


def _triple(values: NDArray[np.int64]) -> tuple[int, int, int]:
    x, y, z = (int(value) for value in values)
    return x, y, z


def _bad(what: str) -> BadReply:
    return BadReply("scanner", "", what)
