"""Zaber ASCII, as text lines: commands out, replies, infos and alerts in.

    command  '/' [device [axis [id|--]]] [words] [':' LRC]
    reply    '@' dd ' ' axis ' ' [id ' '] (OK|RJ) ' ' (IDLE|BUSY) ' ' flag ' ' data [':' LRC]
    info     '#' dd ' ' axis ' ' [id ' '] text [':' LRC]
    alert    '!' dd ' ' axis ' ' (IDLE|BUSY) ' ' flag [' ' data] [':' LRC]

Lines come and go without their CR LF here. See docs/wire/turntable.md for bytes of the maker.
"""

import re
from dataclasses import dataclass
from itertools import takewhile

from drivers.wire.errors import BadReply

# Highest priority first: a reply shows one flag, the first of this order that is set.
FLAGS = {
    "FF": "critical system error",
    "FN": "peripheral not supported",
    "FZ": "peripheral inactive",
    "FH": "hardware emergency stop",
    "FV": "over- or under-voltage",
    "FO": "driver disabled",
    "FC": "current inrush",
    "FM": "motor temperature",
    "FD": "driver disabled",
    "FQ": "encoder error",
    "FI": "index error",
    "FA": "analog encoder sync error",
    "FR": "overdrive limit exceeded",
    "FS": "stalled and stopped",
    "FB": "stream bounds exceeded",
    "FP": "path deviation",
    "FE": "limit error",
    "FT": "excessive twist",
    "WL": "unexpected limit trigger",
    "WV": "voltage out of range",
    "WT": "controller temperature high",
    "WS": "stalled with recovery",
    "WM": "displaced when stationary",
    "WP": "invalid calibration type",
    "WR": "no reference position",
    "WH": "not homed",
    "NC": "manual control",
    "NI": "movement interrupted",
    "ND": "stream discontinuity",
    "NR": "value rounded",
    "NT": "value truncated",
    "NU": "setting update pending",
    "NJ": "joystick calibrating",
}
NO_FLAG = "--"

# Speeds on the wire are microsteps/s times this; accelerations microsteps/s^2 times this / 10000.
SPEED_UNIT = 1.6384
ACCELERATION_UNIT = SPEED_UNIT / 10_000.0

_REPLY = re.compile(r"@(\d\d) (\d) (?:(\d\d) )?(OK|RJ) (IDLE|BUSY) (--|[A-Z][A-Z0-9]) (\S.*)", re.ASCII)
_INFO = re.compile(r"#(\d\d) (\d) (?:(\d\d) )?(.*)", re.ASCII)
_ALERT = re.compile(r"!(\d\d) (\d) (IDLE|BUSY) (--|[A-Z][A-Z0-9])(?: (.*))?", re.ASCII)
_CHECKED = re.compile(r"(.*):([0-9A-Fa-f]{2})", re.ASCII | re.DOTALL)


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """One order to a device; `id` None: the sender wants the reply without one."""

    device: int = 0
    axis: int = 0
    id: int | None = None
    silent: bool = False
    words: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """The answer to one command; `checked` says that an LRC was there, and right."""

    device: int
    axis: int
    id: int | None
    ok: bool
    busy: bool
    flag: str
    data: str
    checked: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Info:
    """A line of extra text that belongs to a reply."""

    device: int
    axis: int
    id: int | None
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Alert:
    """An unsolicited line: the axis came to rest or met a fault."""

    device: int
    axis: int
    busy: bool
    flag: str
    data: str


def lrc(body: bytes) -> int:
    """The two's complement of the 8-bit sum of what stands between the start character and ':'."""
    return -sum(body) & 0xFF


def with_lrc(line: str) -> bytes:
    """The line with ':' and its LRC, two upper-case hex digits."""
    raw = line.encode("ascii")
    return raw + b":%02X" % lrc(raw[1:])


def is_fault(flag: str) -> bool:
    """Whether a warning flag means that the axis cannot go on."""
    return flag.startswith("F")


def encode_command(command: Command) -> bytes:
    """The line of a command, always with its LRC."""
    number = "--" if command.silent else "" if command.id is None else f"{command.id:02d}"
    parts = [str(command.device), str(command.axis), number, *command.words]
    return with_lrc("/" + " ".join(part for part in parts if part))


def decode_command(line: bytes) -> Command | None:
    """The command in a line; None for what a device would pass over: no '/', noise, a wrong LRC.

    Reading starts at the last '/', which is where a device would take up a line cut by noise.
    """
    _, slash, tail = line.rpartition(b"/")
    text = _unchecked(tail)[0] if slash and tail.isascii() else None
    if text is None:
        return None
    words = text.split()
    numbers = list(takewhile(re.compile(r"\d{1,2}|--", re.ASCII).fullmatch, words[:3]))
    if "--" in numbers[:2]:
        return None
    device, axis, number = (*numbers, *("0", "0", "")[len(numbers) :])
    return Command(
        device=int(device),
        axis=int(axis),
        id=int(number) if number.isdigit() else None,
        silent=number == "--",
        words=tuple(words[len(numbers) :]),
    )


def encode_reply(reply: Reply, *, checksum: bool) -> bytes:
    """The line of a reply."""
    outcome = "OK" if reply.ok else "RJ"
    state = "BUSY" if reply.busy else "IDLE"
    line = f"@{_address(reply.device, reply.axis, reply.id)} {outcome} {state} {reply.flag} {reply.data}"
    return with_lrc(line) if checksum else line.encode("ascii")


def encode_alert(alert: Alert, *, checksum: bool) -> bytes:
    """The line of an alert."""
    state = "BUSY" if alert.busy else "IDLE"
    line = f"!{_address(alert.device, alert.axis, None)} {state} {alert.flag} {alert.data}".rstrip()
    return with_lrc(line) if checksum else line.encode("ascii")


def decode_answer(line: bytes) -> Reply | Info | Alert:
    """What a device sent; raises `BadReply` for anything that is not one whole, right line."""
    if not line.isascii():
        raise _bad(line, "is not ASCII")
    text, checked = _unchecked(line[1:])
    if text is None:
        raise _bad(line, "has a wrong checksum")
    text = chr(line[0]) + text if line else ""
    if match := _REPLY.fullmatch(text):
        device, axis, number, outcome, state, flag, data = match.groups()
        return Reply(
            device=int(device),
            axis=int(axis),
            id=None if number is None else int(number),
            ok=outcome == "OK",
            busy=state == "BUSY",
            flag=flag,
            data=data,
            checked=checked,
        )
    if match := _INFO.fullmatch(text):
        device, axis, number, words = match.groups()
        return Info(
            device=int(device), axis=int(axis), id=None if number is None else int(number), text=words
        )
    if match := _ALERT.fullmatch(text):
        device, axis, state, flag, words = match.groups()
        return Alert(device=int(device), axis=int(axis), busy=state == "BUSY", flag=flag, data=words or "")
    raise _bad(line, "is not a reply, info or alert")


def decode_integer(data: str) -> int:
    """A whole number of a data field, strict: no comma, exponent or space; |value| < 10^15."""
    if re.fullmatch(r"-?\d{1,15}", data, re.ASCII) is None:
        raise BadReply("turntable", "", f"{data!r} is not a whole number")
    return int(data)


def decode_flags(data: str) -> tuple[str, ...]:
    """The flags of a reply to `warnings`: `NN F1 F2 ...`, with NN their number."""
    count, *flags = data.split() or [""]
    if not (re.fullmatch(r"\d\d", count, re.ASCII) and int(count) == len(flags)):
        raise BadReply("turntable", "", f"{data!r} is not a list of warnings")
    return tuple(flags)


def _unchecked(body: bytes) -> tuple[str | None, bool]:
    """The body without its LRC and whether it had one; None instead of the body if the LRC is wrong."""
    text = body.decode("ascii")
    match = _CHECKED.fullmatch(text)
    if match is None:
        return text, False
    right = lrc(match[1].encode("ascii")) == int(match[2], 16)
    return (match[1] if right else None), True


def _address(device: int, axis: int, number: int | None) -> str:
    return f"{device:02d} {axis}" if number is None else f"{device:02d} {axis} {number:02d}"


def _bad(line: bytes, why: str) -> BadReply:
    return BadReply("turntable", "", f"{line[:60]!r} {why}")
