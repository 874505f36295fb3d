"""All that the screen shows, as one immutable value, and the pure step from one event to the next.

A screen that has lost the station shows no verdict: `verdict_shown` is None while `live` is False.
"""

from dataclasses import dataclass, field, replace
from functools import singledispatch
from typing import Any

import numpy as np
from numpy.typing import NDArray

from station.events import (
    AlarmCleared,
    AlarmRaised,
    CloudMeasured,
    DeviceStatus,
    Handshake,
    LogLine,
    PartRecorded,
    PartStarted,
    SectionMeasured,
    SnapshotEnd,
    StationStatus,
    StepFinished,
    StepStarted,
    VerdictAcknowledged,
    VerdictReached,
    ViewCaptured,
    unpack,
)

Points = NDArray[np.float32]

STEPS = ("scan", "clean", "register", "twin", "damage", "repair", "sections", "judge", "record")
MAX_RECORDS = 200
MAX_LOG_LINES = 200


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CloudPicture:
    """Points (n, 3); `deviation_mm` (n,) is None while views still arrive and nothing is measured."""

    points_mm: Points
    deviation_mm: Points | None = None
    limit_mm: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ScreenState:
    live: bool = False
    status: StationStatus | None = None
    devices: dict[str, DeviceStatus] = field(default_factory=dict)
    handshake: Handshake | None = None
    part: PartStarted | None = None
    step: str | None = None
    durations_s: dict[str, float] = field(default_factory=dict)
    views_done: int = 0
    angle_deg: float | None = None
    cloud: CloudPicture | None = None
    sections: tuple[SectionMeasured, ...] = ()
    verdict: VerdictReached | None = None
    acknowledged: VerdictAcknowledged | None = None
    alarms: tuple[AlarmRaised, ...] = ()
    records: tuple[PartRecorded, ...] = ()
    log: tuple[LogLine, ...] = ()

    @property
    def verdict_shown(self) -> VerdictReached | None:
        """The verdict to show as present: none while the link is down or a part is being measured."""
        return self.verdict if self.live else None


def lost(state: ScreenState) -> ScreenState:
    """The stream ended: what is known is old, and no verdict is present."""
    return replace(state, live=False)


@singledispatch
def step(event: Any, state: ScreenState) -> ScreenState:
    """The state after one event; an event that the screen does not know changes nothing."""
    return state


@step.register
def _(event: SnapshotEnd, state: ScreenState) -> ScreenState:
    return replace(state, live=True)


@step.register
def _(event: StationStatus, state: ScreenState) -> ScreenState:
    return replace(state, status=event)


@step.register
def _(event: DeviceStatus, state: ScreenState) -> ScreenState:
    return replace(state, devices={**state.devices, event.device: event})


@step.register
def _(event: Handshake, state: ScreenState) -> ScreenState:
    return replace(state, handshake=event)


@step.register
def _(event: PartStarted, state: ScreenState) -> ScreenState:
    return replace(
        state,
        part=event,
        step=None,
        durations_s={},
        views_done=0,
        angle_deg=None,
        cloud=None,
        sections=(),
        verdict=None,
        acknowledged=None,
    )


@step.register
def _(event: StepStarted, state: ScreenState) -> ScreenState:
    return replace(state, step=event.step)


@step.register
def _(event: StepFinished, state: ScreenState) -> ScreenState:
    done = {**state.durations_s, event.step: event.duration_s}
    return replace(state, step=None if state.step == event.step else state.step, durations_s=done)


@step.register
def _(event: ViewCaptured, state: ScreenState) -> ScreenState:
    new = unpack(event.sample_mm, 3)
    old = state.cloud.points_mm if state.cloud is not None and state.cloud.deviation_mm is None else new[:0]
    cloud = CloudPicture(points_mm=np.concatenate([old, new]))
    return replace(state, views_done=event.index + 1, angle_deg=event.angle_deg, cloud=cloud)


@step.register
def _(event: CloudMeasured, state: ScreenState) -> ScreenState:
    points_mm, deviation_mm = unpack(event.points_mm, 3), unpack(event.deviation_mm)
    if len(points_mm) != len(deviation_mm):
        raise ValueError(f"{len(points_mm)} points with {len(deviation_mm)} deviations")
    picture = CloudPicture(points_mm=points_mm, deviation_mm=deviation_mm, limit_mm=event.serviceable_mm)
    return replace(state, cloud=picture)


@step.register
def _(event: SectionMeasured, state: ScreenState) -> ScreenState:
    others = [section for section in state.sections if section.z_mm != event.z_mm]
    return replace(state, sections=tuple(sorted([*others, event], key=lambda section: section.z_mm)))


@step.register
def _(event: VerdictReached, state: ScreenState) -> ScreenState:
    return replace(state, verdict=event, acknowledged=None, step=None, durations_s=dict(event.durations_s))


@step.register
def _(event: VerdictAcknowledged, state: ScreenState) -> ScreenState:
    records = tuple(
        replace(record, acknowledged=True) if record.record_no == event.record_no else record
        for record in state.records
    )
    return replace(state, acknowledged=event, records=records)


@step.register
def _(event: PartRecorded, state: ScreenState) -> ScreenState:
    others = [record for record in state.records if record.record_no != event.record_no]
    newest_first = sorted([event, *others], key=lambda record: -record.record_no)
    return replace(state, records=tuple(newest_first[:MAX_RECORDS]))


@step.register
def _(event: AlarmRaised, state: ScreenState) -> ScreenState:
    others = [alarm for alarm in state.alarms if alarm.number != event.number]
    return replace(state, alarms=tuple(sorted([*others, event], key=_urgency)))


@step.register
def _(event: AlarmCleared, state: ScreenState) -> ScreenState:
    return replace(state, alarms=tuple(alarm for alarm in state.alarms if alarm.number != event.number))


@step.register
def _(event: LogLine, state: ScreenState) -> ScreenState:
    return replace(state, log=(*state.log, event)[-MAX_LOG_LINES:])


def _urgency(alarm: AlarmRaised) -> tuple[bool, int, str]:
    """Unacknowledged before seen, then by priority, then the oldest first."""
    return (alarm.state not in ("UNACK", "RETURNED"), alarm.priority, alarm.at_utc)
