"""The turntable: home it, turn it to an angle, and believe only what its position proves.

Every command carries an id and an LRC; a reply counts for the command whose id it bears and for no
other. Queries are repeated up to three times; a move is sent again only when the position proves that
the table did not move. Each angle is approached turning counter-clockwise, so that backlash always
lies on the same side.
"""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from types import TracebackType
from typing import Self, TypeVar

from drivers.errors import BadReply, DeviceFault, LinkDown, Refused, Timeout
from drivers.line import Line, Trace, open_line
from drivers.wire.turntable import (
    FLAGS,
    SPEED_UNIT,
    Command,
    Reply,
    decode_answer,
    decode_flags,
    decode_integer,
    encode_command,
    is_fault,
)

Value = TypeVar("Value")

_CONNECT_S = 2.0  # a network's time, not the device's: the same however soon a reply is due
_TRIES = 3
_POLL_S = 0.02
_APPROACH_DEG = 1.0  # undershoot of a move that would come from above
_UNREFERENCED = {"WR", "WH"}


@dataclass(frozen=True, slots=True, kw_only=True)
class TurntableIdentity:
    """What the device said of itself when the line was opened."""

    device_id: int
    microsteps_per_turn: int
    speed_deg_per_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TurntableStatus:
    """Where the table stands, and every warning flag it shows."""

    angle_deg: float
    busy: bool
    homed: bool
    flags: tuple[str, ...]


class Turntable:
    """One Zaber rotary axis, as an async context manager; angles are counter-clockwise from home."""

    def __init__(
        self,
        *,
        port: str,
        baud: int = 115_200,
        address: int = 1,
        reply_timeout_s: float = 0.5,
        settle_s: float = 0.05,
        position_tolerance_deg: float = 0.01,
        trace: Trace | None = None,
    ) -> None:
        self.port = port
        self._baud = baud
        self._address = address
        self._reply_timeout_s = reply_timeout_s
        self._settle_s = settle_s
        self._tolerance_deg = position_tolerance_deg
        self._trace = trace
        self._lock = asyncio.Lock()
        self._line: Line | None = None
        self._identity: TurntableIdentity | None = None
        self._checksums = False
        self._homed = False
        self._stops = 0
        self._id = 0

    async def __aenter__(self) -> Self:
        self._line = await open_line(
            "turntable", self.port, baud=self._baud, timeout_s=_CONNECT_S, trace=self._trace
        )
        try:
            self._identity = await self._identify()
        except BaseException:
            self._line.close()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._line is not None:
            self._line.close()
            self._line = None

    @property
    def identity(self) -> TurntableIdentity:
        """What was read at the start."""
        if self._identity is None:
            raise LinkDown("turntable", self.port, "not connected")
        return self._identity

    async def home(self) -> None:
        """Find the reference position and stand at 0 degrees."""
        self._homed = False
        await self._query("warnings clear", faults_pass=True)
        await self._order("home")
        await self._until_idle(self._deadline(360.0) + 30.0)
        status = await self.status()
        if not (status.homed and abs(status.angle_deg) <= self._tolerance_deg):
            raise self._fault(f"after homing it stands at {status.angle_deg:.4f} deg, flags {status.flags}")
        self._homed = True

    async def move_to(self, angle_deg: float) -> float:
        """The angle at which the table came to rest, within the tolerance of `angle_deg` (any turn).

        Raises `DeviceFault` for a table that is not homed, stalls, or stops anywhere else.
        """
        if not self._homed:
            raise self._fault("is not homed: no move")
        stops = self._stops
        here_deg = await self._angle()
        if angle_deg < here_deg - self._tolerance_deg:
            await self._drive(angle_deg - _APPROACH_DEG, stops)
        await self._drive(angle_deg, stops)
        await asyncio.sleep(self._settle_s)
        rest_deg = await self._angle()
        if not abs(rest_deg - angle_deg) <= self._tolerance_deg:
            raise self._fault(f"drifted to {rest_deg:.4f} deg, wanted {angle_deg:.4f}")
        return rest_deg

    async def stop(self) -> None:
        """Bring the table to rest; an unfinished `move_to` then fails."""
        self._stops += 1
        await self._query("stop", faults_pass=True)
        await self._until_idle(self._deadline(360.0), faults_pass=True)

    async def status(self) -> TurntableStatus:
        """Position, motion and warning flags, faults among them."""
        reply = await self._query("warnings", faults_pass=True)
        flags = self._read(decode_flags, reply)
        return TurntableStatus(
            angle_deg=await self._angle(faults_pass=True),
            busy=reply.busy,
            homed=_UNREFERENCED.isdisjoint(flags),
            flags=flags,
        )

    async def _identify(self) -> TurntableIdentity:
        device_id = await self._setting("deviceid")
        steps = await self._setting("limit.cycle.dist")
        speed = await self._setting("maxspeed")
        if not (steps > 0 and speed > 0):
            raise BadReply("turntable", self.port, f"{steps} microsteps a turn at speed {speed}")
        await self._ask_for_checksums()
        return TurntableIdentity(
            device_id=device_id,
            microsteps_per_turn=steps,
            speed_deg_per_s=speed / SPEED_UNIT * 360.0 / steps,
        )

    async def _ask_for_checksums(self) -> None:
        """From here on a reply without its LRC is noise, if the device can send them."""
        with suppress(Refused):
            await self._query("set comm.checksum 1", faults_pass=True)
            self._checksums = (await self._query("get comm.checksum", faults_pass=True)).checked

    async def _drive(self, angle_deg: float, stops: int) -> None:
        """Go to `angle_deg`; send once more only if the table provably stands where it stood."""
        steps = round(angle_deg * self.identity.microsteps_per_turn / 360.0)
        start_deg = await self._angle()
        end_deg = start_deg
        for _ in range(2):
            if abs(end_deg - angle_deg) <= self._tolerance_deg:
                return
            if abs(end_deg - start_deg) > self._tolerance_deg:
                break
            if stops != self._stops:
                raise self._fault(f"was stopped on its way to {angle_deg:.4f} deg")
            await self._order(f"move abs {steps}")
            await self._until_idle(self._deadline(abs(angle_deg - start_deg)))
            end_deg = await self._angle()
        if not abs(end_deg - angle_deg) <= self._tolerance_deg:
            raise self._fault(f"stopped at {end_deg:.4f} deg, wanted {angle_deg:.4f}")

    async def _order(self, words: str) -> None:
        """Send a motion command once. A lost reply passes: what the table does then is what counts."""
        with suppress(Timeout, BadReply):
            await self._query(words, tries=1)

    async def _until_idle(self, timeout_s: float, *, faults_pass: bool = False) -> None:
        clock = asyncio.get_running_loop().time
        deadline = clock() + timeout_s
        while (await self._query("", faults_pass=faults_pass)).busy:
            if not clock() <= deadline:
                raise self._fault(f"still moving after {timeout_s:.1f} s")
            await asyncio.sleep(_POLL_S)

    async def _angle(self, *, faults_pass: bool = False) -> float:
        reply = await self._query("get pos", faults_pass=faults_pass)
        return self._read(decode_integer, reply) * 360.0 / self.identity.microsteps_per_turn

    async def _setting(self, name: str) -> int:
        return self._read(decode_integer, await self._query(f"get {name}", faults_pass=True))

    def _read(self, decode: Callable[[str], Value], reply: Reply) -> Value:
        try:
            return decode(reply.data)
        except BadReply as error:
            raise error.at(self.port) from None

    async def _query(self, words: str, *, tries: int = _TRIES, faults_pass: bool = False) -> Reply:
        """The accepted reply to a command; repeats after silence or noise, raises what the reply shows."""
        async with self._lock:
            reply = await self._ask(words, tries)
        if not faults_pass and is_fault(reply.flag):
            raise self._fault(f"{FLAGS.get(reply.flag, 'fault')} ({reply.flag})")
        if not reply.ok:
            raise Refused("turntable", self.port, f"rejected {words!r}: {reply.data}")
        if self._homed and reply.flag in _UNREFERENCED:
            self._homed = False
            raise self._fault(f"lost its reference ({reply.flag}): it was restarted")
        return reply

    async def _ask(self, words: str, tries: int) -> Reply:
        failure: BadReply | Timeout | None = None
        for _ in range(tries):
            try:
                return await self._exchange(words)
            except (BadReply, Timeout) as error:
                failure = error
        assert failure is not None
        raise type(failure)("turntable", self.port, f"{words or 'status poll'!r}: {failure.what}")

    async def _exchange(self, words: str) -> Reply:
        """One command and the reply with its id; anything else on the line is passed over."""
        if self._line is None:
            raise LinkDown("turntable", self.port, "not connected")
        self._id = (self._id + 1) % 100
        command = Command(device=self._address, axis=1, id=self._id, words=tuple(words.split()))
        self._line.inbox.lines.clear()
        await self._line.send(encode_command(command) + b"\r\n", self._reply_timeout_s)
        clock = asyncio.get_running_loop().time
        deadline = clock() + self._reply_timeout_s
        noise: BadReply | None = None
        while True:
            try:
                answer = decode_answer(await self._line.inbox.next_line(max(deadline - clock(), 0.0)))
            except BadReply as error:
                noise = error
                continue
            except Timeout:
                what = f"no reply within {self._reply_timeout_s:g} s"
                raise noise or Timeout("turntable", self.port, what) from None
            if isinstance(answer, Reply) and self._belongs(answer, command):
                return answer

    def _belongs(self, reply: Reply, command: Command) -> bool:
        trusted = reply.checked or not self._checksums
        return trusted and (reply.device, reply.id) == (command.device, command.id)

    def _deadline(self, turn_deg: float) -> float:
        """Longest time for a turn: half as much again as at full speed, and a second to start and stop."""
        return 1.5 * turn_deg / self.identity.speed_deg_per_s + 1.0

    def _fault(self, what: str) -> DeviceFault:
        return DeviceFault("turntable", self.port, what)
