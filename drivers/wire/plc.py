"""The registers between PLC and station: one table, and the values that stand in them.

The station is the Modbus server. The PLC writes 0-28, the station 100-193; each register has one
writer. 32- and 64-bit numbers stand high word first, text two characters a register, high byte first.
See docs/wire/plc.md.
"""

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag

from drivers.wire.errors import BadReply


@dataclass(frozen=True, slots=True, kw_only=True)
class Register:
    """One row of the map: first address, number of 16-bit registers, name."""

    address: int
    count: int
    name: str


REQUEST_MAP = tuple(
    Register(address=address, count=count, name=name)
    for address, count, name in (
        (0, 1, "CTRL"),
        (1, 1, "PLC_HB"),
        (2, 1, "PLC_EPOCH"),
        (3, 2, "REQ_SEQ"),
        (5, 1, "RECIPE"),
        (6, 1, "FIXTURE"),
        (7, 1, "ECHO_ST_HB"),
        (8, 2, "ACK_SEQ"),
        (10, 1, "ACK_CODE"),
        (11, 1, "SERIAL_LEN"),
        (12, 16, "SERIAL"),
        (28, 1, "REQ_CRC"),
    )
)
STATION_MAP = tuple(
    Register(address=address, count=count, name=name)
    for address, count, name in (
        (100, 1, "STATUS"),
        (101, 1, "ST_HB"),
        (102, 1, "ST_EPOCH"),
        (103, 1, "STATE"),
        (104, 2, "RES_SEQ"),
        (106, 1, "VERDICT"),
        (107, 1, "VERDICT_INV"),
        (108, 1, "REASON"),
        (109, 1, "FAULT_CODE"),
        (110, 2, "WORST_DEVIATION"),
        (112, 2, "MISSING_VOLUME"),
        (114, 1, "DEFECTS"),
        (115, 1, "COVERAGE"),
        (116, 16, "SERIAL_ECHO"),
        (132, 2, "RECORD_ID"),
        (134, 4, "TIME_MS"),
        (138, 1, "RES_CRC"),
        (139, 1, "RES_SEQ_LOW"),
        (190, 4, "PATTERN"),
    )
)
REQUEST_COUNT = 29
STATUS, STATION_HEARTBEAT, STATION_EPOCH, STATE = 100, 101, 102, 103
RESULT, RESULT_COUNT = 104, 36
REASON, FAULT_CODE = 108, 109
PATTERN, PATTERN_VALUES = 190, (0x1234, 0x1234, 0x5678, 0x4142)
REGISTER_COUNT = 200
UNIT_IDS = (0, 1, 255)

_SERIAL = re.compile(rb"[A-Z0-9-]{1,32}")
_REQUEST = struct.Struct(">3H I 3H I 2H 32s H".replace(" ", ""))
_BLOCK = struct.Struct(">I4H i I 2H 32s I Q 2H".replace(" ", ""))


class Ctrl(IntFlag):
    """Register 0."""

    ENABLE = 1
    PART_PRESENT = 2
    START = 4
    RESULT_ACK = 8
    ABORT = 16
    RESET_FAULT = 32
    PART_CHANGED = 64


NO_CTRL = Ctrl(0)


class StatusBits(IntFlag):
    """Register 100."""

    ONLINE = 1
    READY = 2
    START_ACK = 4
    BUSY = 8
    RESULT_VALID = 16
    FAULT = 32
    PLC_LOST = 64
    MANUAL = 128
    SEQ_REUSED = 256
    PART_MISMATCH = 512
    ABORTED = 1024
    SAFE_TO_UNLOAD = 2048
    CAL_DUE = 4096


class VerdictCode(IntEnum):
    """Register 106."""

    NONE = 0
    PASS = 1
    REPAIR = 2
    SCRAP = 3
    HOLD = 4


class FaultCode(IntEnum):
    """Register 109: why a request was refused."""

    NONE = 0
    BAD_CRC = 1
    NEW_SEQUENCE_NEEDED = 2
    SEQUENCE_REUSED = 3
    UNKNOWN_RECIPE = 4


class AckCode(IntEnum):
    """Register 10: what the PLC did with the verdict."""

    NONE = 0
    ROUTED = 1
    NOT_ROUTED = 2
    OVERRIDDEN = 3


def crc16(data: bytes) -> int:
    """CRC-16/Modbus: start 0xFFFF, reflected polynomial 0x8005; "123456789" gives 0x4B37."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc


@dataclass(frozen=True, slots=True, kw_only=True)
class PlcRequest:
    """Registers 0-28. `serial` is None when the text is not 1-32 characters of [A-Z0-9-], NUL-padded."""

    ctrl: Ctrl = NO_CTRL
    heartbeat: int = 0
    epoch: int = 0
    sequence: int = 0
    recipe: int = 0
    fixture: int = 0
    echo_station_heartbeat: int = 0
    ack_sequence: int = 0
    ack_code: int = 0
    serial: str | None = None
    crc: int = 0
    crc_expected: int = 0

    def has(self, bits: Ctrl) -> bool:
        """Whether all of these control bits are set."""
        return self.ctrl & bits == bits

    def crc_ok(self, *, accept_zero: bool) -> bool:
        """Whether REQ_CRC fits the registers; 0 stands for a PLC that cannot compute it."""
        return self.crc == self.crc_expected or (accept_zero and self.crc == 0)


def decode_request(registers: Sequence[int]) -> PlcRequest:
    """The request in registers 0-28; raises `BadReply` unless these are 29 numbers of 16 bits."""
    raw = _to_bytes(registers, REQUEST_COUNT)
    ctrl, heartbeat, epoch, sequence, recipe, fixture, echo, ack_sequence, ack_code, length, text, crc = (
        _REQUEST.unpack(raw)
    )
    return PlcRequest(
        ctrl=Ctrl(ctrl),
        heartbeat=heartbeat,
        epoch=epoch,
        sequence=sequence,
        recipe=recipe,
        fixture=fixture,
        echo_station_heartbeat=echo,
        ack_sequence=ack_sequence,
        ack_code=ack_code,
        serial=_decode_serial(text, length),
        crc=crc,
        crc_expected=crc16(raw[6:14] + raw[22:56]),
    )


def encode_request(request: PlcRequest) -> list[int]:
    """Registers 0-28 of a request, with the right REQ_CRC whatever `request.crc` says."""
    text = (request.serial or "").encode("ascii")
    raw = _REQUEST.pack(
        request.ctrl,
        request.heartbeat,
        request.epoch,
        request.sequence,
        request.recipe,
        request.fixture,
        request.echo_station_heartbeat,
        request.ack_sequence,
        request.ack_code,
        len(text),
        text,
        0,
    )
    return [*_to_registers(raw[:-2]), crc16(raw[6:14] + raw[22:56])]


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultBlock:
    """Registers 104-139 of one published verdict."""

    sequence: int
    verdict: VerdictCode
    reason: int = 0
    fault_code: int = 0
    worst_deviation_um: int = 0
    missing_volume_mm3_x1000: int = 0
    defects: int = 0
    coverage_percent_x100: int = 0
    serial: str
    record_id: int
    time_ms: int

    def __post_init__(self) -> None:
        if not (self.verdict and _SERIAL.fullmatch(self.serial.encode())):
            raise ValueError(f"{self.serial!r}: a result needs a verdict and a serial of [A-Z0-9-]")
        self._pack()

    def encode(self) -> tuple[int, ...]:
        """The 36 registers, with complement, CRC over 104-137 and the low word of the sequence."""
        return _to_registers(self._pack())

    def _pack(self) -> bytes:
        try:
            head = _BLOCK.pack(
                self.sequence,
                self.verdict,
                0xFFFF - self.verdict,
                self.reason,
                self.fault_code,
                self.worst_deviation_um,
                self.missing_volume_mm3_x1000,
                self.defects,
                self.coverage_percent_x100,
                self.serial.encode("ascii"),
                self.record_id,
                self.time_ms,
                0,
                0,
            )[:-4]
        except struct.error as error:
            raise ValueError(f"result of sequence {self.sequence}: {error}") from error
        return head + struct.pack(">2H", crc16(head), self.sequence & 0xFFFF)


def decode_result(registers: Sequence[int]) -> ResultBlock:
    """The verdict in registers 104-139; raises `BadReply` naming the check that it does not meet."""
    raw = _to_bytes(registers, RESULT_COUNT)
    fields = _BLOCK.unpack(raw)
    sequence, verdict, inverse, reason, fault, worst, volume, defects, coverage = fields[:9]
    text, record_id, time_ms, crc, sequence_low = fields[9:]
    serial = _decode_serial(text, len(text.rstrip(b"\0")))
    checks = {
        "verdict code": verdict in (1, 2, 3, 4),
        "complement": verdict + inverse == 0xFFFF,
        "RES_CRC": crc == crc16(raw[:-4]),
        "low word of RES_SEQ": sequence_low == sequence & 0xFFFF,
        "serial": serial is not None,
    }
    if serial is None or not all(checks.values()):
        wrong = ", ".join(name for name, ok in checks.items() if not ok)
        raise BadReply("station", "", f"result block: wrong {wrong}")
    return ResultBlock(
        sequence=sequence,
        verdict=VerdictCode(verdict),
        reason=reason,
        fault_code=fault,
        worst_deviation_um=worst,
        missing_volume_mm3_x1000=volume,
        defects=defects,
        coverage_percent_x100=coverage,
        serial=serial,
        record_id=record_id,
        time_ms=time_ms,
    )


def _decode_serial(text: bytes, length: int) -> str | None:
    plain = text[:length]
    whole = length <= len(text) and not text[length:].strip(b"\0")
    return plain.decode("ascii") if whole and _SERIAL.fullmatch(plain) else None


def _to_bytes(registers: Sequence[int], count: int) -> bytes:
    if len(registers) != count or not all(0 <= value <= 0xFFFF for value in registers):
        raise BadReply("plc", "", f"{len(registers)} registers, want {count} of 16 bits")
    return struct.pack(f">{count}H", *registers)


def _to_registers(raw: bytes) -> tuple[int, ...]:
    return struct.unpack(f">{len(raw) // 2}H", raw)
