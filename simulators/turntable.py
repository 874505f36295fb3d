"""A rotary axis that speaks Zaber ASCII.

`TurntableDevice` answers one command at a time, without clock or socket: every call brings the time.
`TurntableSession` is one client's end of the line.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from math import copysign

from drivers.wire.lines import LineSplitter
from drivers.wire.turntable import (
    ACCELERATION_UNIT,
    FLAGS,
    NO_FLAG,
    SPEED_UNIT,
    Alert,
    Command,
    Reply,
    decode_command,
    encode_alert,
    encode_reply,
)
from simulators.motion import Motion, change_speed, move_to, rest

STEPS_PER_TURN = 1_536_000  # 0.000234375 deg a microstep
_LIMIT = 1_000 * STEPS_PER_TURN
_FASTEST = 10_000_000  # data of a speed; `move vel` may exceed maxspeed
_LONGEST_COMMAND = 256
_POWER_UP_STEPS = 200_000.0  # where the axis happens to stand when it is switched on


class Rejected(Exception):
    """The word of an RJ reply."""


@dataclass(slots=True)
class Setting:
    """One `get`/`set` value: whole numbers within bounds; without bounds it is read-only text."""

    value: str
    bounds: tuple[int, int] | None = None


def _settings() -> dict[str, Setting]:
    read_only = {
        "deviceid": "50942",
        "system.serial": "93001",
        "version": "7.38",
        "version.build": "20123",
        "device.hw.modified": "0",
        "system.axiscount": "1",
        "system.voltage": "48.0",
        "driver.temperature": "35.0",
        "comm.address": "1",
        "comm.command.packets.max": "1",
        "comm.word.size.max": "50",
        "get.settings.max": "1",
        "resolution": "64",
        "peripheralid": "0",
        "peripheral.serial": "0",
        "peripheral.hw.modified": "0",
        "limit.cycle.dist": str(STEPS_PER_TURN),
        "limit.min": str(-_LIMIT),
        "limit.max": str(_LIMIT),
    }
    writable = {
        "maxspeed": ("983040", (1, _FASTEST)),
        "accel": ("819", (1, 100_000)),
        "comm.alert": ("0", (0, 1)),
        "comm.checksum": ("0", (0, 1)),
        "system.access": ("1", (1, 2)),
        "system.led.enable": ("1", (0, 1)),
        "knob.enable": ("1", (0, 1)),
        "user.data.0": ("0", (-(2**31), 2**31 - 1)),
    }
    return {name: Setting(value) for name, value in read_only.items()} | {
        name: Setting(value, bounds) for name, (value, bounds) in writable.items()
    }


@dataclass(slots=True)
class TurntableDevice:
    """One axis at one address. `position` on the wire is the physical one less the reference."""

    address: int = 1
    flags: set[str] = field(default_factory=lambda: {"WR"})
    _motion: Motion = field(default_factory=lambda: rest(0.0, _POWER_UP_STEPS))
    _reference: float = _POWER_UP_STEPS
    _homing: bool = False
    _parked: bool = False
    _was_busy: bool = False
    _stall_at: float | None = None
    _settings: dict[str, Setting] = field(default_factory=_settings)

    def angle_deg(self, now_s: float) -> float:
        """Where the table truly stands: 0..360 counter-clockwise from its home mark."""
        self._advance(now_s)
        return self._motion.at(now_s)[0] % STEPS_PER_TURN * 360.0 / STEPS_PER_TURN

    def stall_after(self, steps: float, now_s: float) -> None:
        """Arm a jam: the axis stops with FS once it is `steps` microsteps away from where it is now."""
        position, _ = self._motion.at(now_s)
        if not self._busy(now_s):
            self._halt(now_s, position)  # only the way still to come counts
        self._stall_at = position + steps

    def restart(self, now_s: float) -> None:
        """A power cycle: the axis stops where it is and forgets its reference; settings stay."""
        position, _ = self._motion.at(now_s)
        self._motion = rest(now_s, position)
        self._reference = position
        self._homing = self._parked = False
        self.flags = {"WR"}

    def answer(self, line: bytes, now_s: float) -> bytes | None:
        """The reply line to a line from the wire; None where a device stays silent."""
        command = decode_command(line)
        if command is None or command.device not in (0, self.address):
            return None
        self._advance(now_s)
        try:
            data = self._obey(command, now_s)
        except Rejected as word:
            return self._reply(command, now_s, str(word), ok=False)
        return self._reply(command, now_s, data, ok=True)

    def alert(self, now_s: float) -> bytes | None:
        """The alert line that is due, once after each motion, if alerts are on."""
        self._advance(now_s)
        stopped = self._was_busy and not self._busy(now_s)
        self._was_busy = self._busy(now_s)
        if not stopped or self._settings["comm.alert"].value == "0":
            return None
        alert = Alert(device=self.address, axis=1, busy=False, flag=self._flag(), data="")
        return encode_alert(alert, checksum=self._checksums)

    @property
    def _checksums(self) -> bool:
        return self._settings["comm.checksum"].value == "1"

    def _reply(self, command: Command, now_s: float, data: str, *, ok: bool) -> bytes | None:
        self._was_busy = self._was_busy or self._busy(now_s)
        if command.silent:
            return None
        reply = Reply(
            device=self.address,
            axis=command.axis,
            id=command.id,
            ok=ok,
            busy=self._busy(now_s),
            flag=self._flag(),
            data=data,
        )
        return encode_reply(reply, checksum=self._checksums)

    def _flag(self) -> str:
        return next((flag for flag in FLAGS if flag in self.flags), NO_FLAG)

    def _busy(self, now_s: float) -> bool:
        return now_s < self._motion.end_s or self._motion.at(now_s)[1] != 0.0

    def _advance(self, now_s: float) -> None:
        """Let happen what the axis meets on its way: a jam, the end of homing, a limit."""
        position, speed = self._motion.at(now_s)
        if self._stall_at is not None and self._passed(self._stall_at, position):
            self._halt(now_s, self._stall_at)
            self.flags.add("FS")
            self._homing, self._stall_at = False, None
        elif self._homing and not self._busy(now_s):
            self._reference = position
            self._homing = False
            self.flags -= {"WR", "WH"}
        elif speed != 0.0 and abs(position - self._reference) > _LIMIT:
            self._halt(now_s, self._reference + copysign(_LIMIT, position - self._reference))

    def _passed(self, mark: float, position: float) -> bool:
        start = self._motion.position
        return min(start, position) <= mark <= max(start, position) and start != position

    def _halt(self, now_s: float, position: float) -> None:
        self._motion = rest(now_s, position)

    def _obey(self, command: Command, now_s: float) -> str:
        """The data of an OK reply; raises `Rejected`."""
        if command.axis > 1:
            raise Rejected("BADAXIS")
        if not command.words:
            return "0"
        verb, *arguments = command.words
        action = {
            "get": self._get,
            "set": self._set,
            "home": self._home,
            "move": self._move,
            "stop": self._stop,
            "estop": self._emergency_stop,
            "warnings": self._warnings,
            "driver": self._driver,
            "tools": self._tools,
            "system": self._system,
        }.get(verb)
        if action is None:
            raise Rejected("BADCOMMAND")
        return action(arguments, now_s)

    def _get(self, arguments: list[str], now_s: float) -> str:
        (name,) = _exactly(1, arguments)
        if name in ("pos", "encoder.pos"):
            return str(round(self._motion.at(now_s)[0] - self._reference))
        if name not in self._settings:
            raise Rejected("BADCOMMAND")
        return self._settings[name].value

    def _set(self, arguments: list[str], now_s: float) -> str:
        name, text = _exactly(2, arguments)
        if name == "pos":
            self._reference = self._motion.at(now_s)[0] - _integer(text)
            if "WR" in self.flags:
                self.flags = (self.flags - {"WR"}) | {"WH"}
            return "0"
        setting = self._settings.get(name)
        if setting is None or setting.bounds is None:
            raise Rejected("BADCOMMAND")
        if not setting.bounds[0] <= _integer(text) <= setting.bounds[1]:
            raise Rejected("BADDATA")
        setting.value = str(_integer(text))
        return "0"

    def _home(self, arguments: list[str], now_s: float) -> str:
        _exactly(0, arguments)
        here = self._motion.at(now_s)[0]
        self._go(now_s, here - here % STEPS_PER_TURN, self._top(), self._rate())
        self._homing = True
        return "0"

    def _move(self, arguments: list[str], now_s: float) -> str:
        kind, *numbers = arguments or [""]
        position = self._motion.at(now_s)[0]
        if kind in ("min", "max"):
            _exactly(0, numbers)
            side = 1 if kind == "max" else -1
            self._go(now_s, self._reference + side * _LIMIT, self._top(), self._rate())
        elif kind in ("abs", "rel"):
            distance, top, rate = self._move_arguments(numbers)
            target = distance + (self._reference if kind == "abs" else position)
            if abs(target - self._reference) > _LIMIT:
                raise Rejected("BADDATA")
            self._go(now_s, target, top, rate)
        elif kind == "vel":
            self._turn(now_s, numbers)
        else:
            raise Rejected("BADCOMMAND")
        return "0"

    def _turn(self, now_s: float, numbers: list[str]) -> None:
        data = _integer(*_exactly(1, numbers))
        if abs(data) > _FASTEST:
            raise Rejected("BADDATA")
        self._begin(now_s)
        position, now = self._motion.at(now_s)
        self._motion = change_speed(now_s, position, now, data / SPEED_UNIT, self._rate())

    def _move_arguments(self, numbers: list[str]) -> tuple[int, float, float]:
        """Distance, and the speed and acceleration that may follow it."""
        if not 1 <= len(numbers) <= 3:
            raise Rejected("BADCOMMAND")
        distance, *rest = map(_integer, numbers)
        if any(value <= 0 for value in rest):
            raise Rejected("BADDATA")
        top = rest[0] / SPEED_UNIT if rest else self._top()
        return distance, top, rest[1] / ACCELERATION_UNIT if len(rest) > 1 else self._rate()

    def _go(self, now_s: float, target: float, top: float, rate: float) -> None:
        self._begin(now_s)
        position, speed = self._motion.at(now_s)
        self._motion = move_to(now_s, position, speed, target, top, rate)

    def _begin(self, now_s: float) -> None:
        """What every motion order does first: refuse where it must, note the motion that it cuts short."""
        if "FO" in self.flags:
            raise Rejected("DRIVERDISABLED")
        if self._parked:
            raise Rejected("PARKED")
        self.flags.discard("NI")
        if self._busy(now_s):
            self.flags.add("NI")
        self._homing = False

    def _stop(self, arguments: list[str], now_s: float) -> str:
        _exactly(0, arguments)
        position, speed = self._motion.at(now_s)
        if self._busy(now_s):
            self.flags.add("NI")
            self._homing = False
            self._motion = change_speed(now_s, position, speed, 0.0, self._rate())
        return "0"

    def _emergency_stop(self, arguments: list[str], now_s: float) -> str:
        self._stop(arguments, now_s)
        self._halt(now_s, self._motion.at(now_s)[0])
        return "0"

    def _warnings(self, arguments: list[str], _now_s: float) -> str:
        shown = [flag for flag in FLAGS if flag in self.flags]
        if arguments == ["clear"]:
            self.flags &= {"WR", "WH", "FO"}
        elif arguments:
            raise Rejected("BADCOMMAND")
        return " ".join([f"{len(shown):02d}", *shown])

    def _driver(self, arguments: list[str], now_s: float) -> str:
        if arguments == ["disable"]:
            self._halt(now_s, self._motion.at(now_s)[0])
            self.flags.add("FO")
        elif arguments == ["enable"]:
            self.flags.discard("FO")
        else:
            raise Rejected("BADCOMMAND")
        return "0"

    def _tools(self, arguments: list[str], now_s: float) -> str:
        if arguments[:1] == ["echo"]:
            return " ".join(arguments[1:]) or "0"
        if arguments not in (["parking", "park"], ["parking", "unpark"]):
            raise Rejected("BADCOMMAND")
        if self._busy(now_s):
            raise Rejected("STATUSBUSY")
        self._parked = arguments[1] == "park"
        return "0"

    def _system(self, arguments: list[str], now_s: float) -> str:
        if arguments != ["reset"]:
            raise Rejected("BADCOMMAND")
        self.restart(now_s)
        return "0"

    def _top(self) -> float:
        return int(self._settings["maxspeed"].value) / SPEED_UNIT

    def _rate(self) -> float:
        return int(self._settings["accel"].value) / ACCELERATION_UNIT


class TurntableSession:
    """One client of the device: its bytes to lines, the device's replies to bytes."""

    def __init__(self, device: TurntableDevice, clock: Callable[[], float]) -> None:
        self._device = device
        self._clock = clock
        self._lines = LineSplitter(_LONGEST_COMMAND)

    def feed(self, data: bytes) -> list[bytes]:
        """The replies to what came."""
        replies = (self._device.answer(line, self._clock()) for line in self._lines.feed(data))
        return [reply + b"\r\n" for reply in replies if reply is not None]


def _exactly(count: int, arguments: list[str]) -> list[str]:
    if len(arguments) != count:
        raise Rejected("BADCOMMAND")
    return arguments


def _integer(text: str) -> int:
    if re.fullmatch(r"-?\d{1,15}", text, re.ASCII) is None:
        raise Rejected("BADDATA")
    return int(text)
