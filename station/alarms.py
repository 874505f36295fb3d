"""The alarm engine: a pure function of what was raised, seen and reset.

An alarm asks for an operator's response. It is first UNACK; once seen ACK; RETURNED when its cause has
gone unseen. Priorities 1 and 2 latch: seen and gone they stay LATCHED until reset. The first alarm that
stops the cell is marked first-out; what follows until the reset is its consequence.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

Priority = Literal[1, 2, 3, 4]
AlarmState = Literal["UNACK", "ACK", "RETURNED", "LATCHED"]


@dataclass(frozen=True, slots=True, kw_only=True)
class AlarmKind:
    """What an alarm number means. `stops`: no part is accepted while it stands.
    `person`: only the operator's own reset clears it, never the PLC's."""

    number: int
    priority: Priority
    text: str
    action: str
    stops: bool = False
    person: bool = False


def _table(*rows: tuple[int, Priority, str, str]) -> dict[int, AlarmKind]:
    return {
        number: AlarmKind(
            number=number,
            priority=priority,
            text=text,
            action=action,
            stops=priority <= 2 and number not in _ADVISORY,
            person=number in (2, 3, 4),
        )
        for number, priority, text, action in rows
    }


# These latch until they are seen and reset, but a healthy cell goes on with the next part.
_ADVISORY = frozenset({121, 124, 131})

KINDS = _table(
    (2, 1, "RESULT STORE FAILED. No verdicts can be given", "Call maintenance; hold the part"),
    (3, 1, "RECORD CHAIN BROKEN", "Call quality"),
    (101, 2, "TURNTABLE NOT RESPONDING", "Check cable and power, then RESET"),
    (102, 2, "TURNTABLE STALL OR LIMIT", "Remove the obstruction, then RESET"),
    (103, 2, "TURNTABLE POSITION UNCERTAIN, must be homed", "RESET (homes)"),
    (111, 2, "SCANNER NOT RESPONDING", "Check network and power, then RESET"),
    (112, 2, "SCANNER IDENTITY OR PROTOCOL CHANGED", "Quality releases the scanner, then RESET"),
    (121, 2, "PLC LINK LOST. The part waits", "Check the network"),
    (124, 2, "VERDICT NOT ACKNOWLEDGED. Hold the part", "Hold the part, check the PLC"),
    (131, 2, "PART UNRESOLVED AFTER INTERRUPTION", "Remove the part and inspect it again"),
    (132, 2, "DISK FULL. Stopped before loss", "Archive old jobs, then RESET"),
    (133, 2, "CONFIGURATION CHANGED OR INVALID", "Restore the configuration or start again"),
    (134, 2, "CALIBRATION EXPIRED OR CHANGED", "Calibrate, then start again"),
    (136, 2, "INTERNAL ERROR", "RESET once, then call maintenance"),
    (201, 3, "SCAN INCOMPLETE", "Inspect the part again"),
    (202, 3, "SCAN DATA CORRUPT", "Inspect the part again"),
    (204, 3, "COVERAGE TOO LOW", "Clean the part, inspect it again"),
    (206, 3, "NO PART SEEN", "Load the part"),
    (209, 3, "ALIGNMENT FAILED OR AMBIGUOUS", "Load the part again"),
    (210, 3, "A CHARACTERISTIC WAS NOT MEASURED", "Inspect the part again"),
    (211, 3, "REPAIR VOLUME NOT VALID", "Measure by hand"),
    (212, 3, "BORDERLINE", "Quality decides"),
    (213, 3, "SERIAL NUMBER MISSING OR INVALID", "Check the label"),
    (214, 3, "STOPPED, the part has no verdict", "Inspect the part again"),
    (215, 3, "CALCULATION TIMEOUT", "Inspect the part again"),
    (216, 3, "CALCULATION FAILED", "Inspect the part again; call maintenance if it repeats"),
    (306, 4, "DUPLICATE REQUEST", "None; call controls if it repeats"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarm:
    """One standing alarm. `active`: its cause is present."""

    kind: AlarmKind
    detail: str
    active: bool
    seen: bool
    first_out: bool
    at_utc: str

    @property
    def state(self) -> AlarmState:
        if self.active:
            return "ACK" if self.seen else "UNACK"
        return "LATCHED" if self.seen else "RETURNED"

    @property
    def text(self) -> str:
        return f"{self.kind.text}: {self.detail}" if self.detail else self.kind.text


@dataclass(frozen=True, slots=True, kw_only=True)
class Alarms:
    """All standing alarms, oldest first, at most one of each number."""

    standing: tuple[Alarm, ...] = ()

    def __getitem__(self, number: int) -> Alarm | None:
        return next((alarm for alarm in self.standing if alarm.kind.number == number), None)

    @property
    def blocking(self) -> tuple[Alarm, ...]:
        """Those that keep the cell from accepting a part."""
        return tuple(alarm for alarm in self.standing if alarm.kind.stops)


def raised(alarms: Alarms, number: int, detail: str, at_utc: str, *, lasting: bool = True) -> Alarms:
    """With alarm `number` present; one that stands already becomes unseen again.

    `lasting` false: an occurrence without a lasting cause, such as a part that could not be measured."""
    kind = KINDS[number]
    alarm = Alarm(
        kind=kind,
        detail=detail,
        active=lasting,
        seen=False,
        first_out=kind.stops and not alarms.blocking,
        at_utc=at_utc,
    )
    before = alarms[number]
    if before is None:
        return Alarms(standing=(*alarms.standing, alarm))
    again = replace(alarm, first_out=before.first_out, at_utc=before.at_utc)
    return Alarms(standing=tuple(again if a is before else a for a in alarms.standing))


def cause_gone(alarms: Alarms, number: int) -> Alarms:
    """With the cause of alarm `number` gone."""
    return _settled(
        replace(alarm, active=False) if alarm.kind.number == number else alarm for alarm in alarms.standing
    )


def acknowledged(alarms: Alarms) -> Alarms:
    """With every alarm seen."""
    return _settled(replace(alarm, seen=True) for alarm in alarms.standing)


def reset(alarms: Alarms, *, by_person: bool) -> Alarms:
    """Without the alarms that are seen and whose cause is gone; some need a person to clear them."""
    return Alarms(
        standing=tuple(
            alarm
            for alarm in alarms.standing
            if alarm.active or not alarm.seen or (alarm.kind.person and not by_person)
        )
    )


def next_part(alarms: Alarms) -> Alarms:
    """Without the alarms that concern the part before: it has its record."""
    return Alarms(standing=tuple(alarm for alarm in alarms.standing if alarm.kind.priority <= 2))


def changes(before: Alarms, now: Alarms) -> tuple[tuple[Alarm, ...], tuple[int, ...]]:
    """The alarms that are new or changed, and the numbers that are gone."""
    changed = tuple(alarm for alarm in now.standing if alarm not in before.standing)
    left = {alarm.kind.number for alarm in now.standing}
    return changed, tuple(a.kind.number for a in before.standing if a.kind.number not in left)


def _settled(alarms: Iterable[Alarm]) -> Alarms:
    """Without what neither latches nor waits to be seen."""
    return Alarms(standing=tuple(a for a in alarms if a.kind.priority <= 2 or a.active or not a.seen))
