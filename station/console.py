"""The station's events as plain lines, for terminals without a screen and for log files."""

import sys

from station.events import (
    AlarmCleared,
    AlarmRaised,
    DeviceStatus,
    Event,
    LogLine,
    PartStarted,
    StationStatus,
    VerdictAcknowledged,
    VerdictReached,
    ViewCaptured,
    printable,
)


def line_of(event: Event) -> str | None:
    """One line for a person, or None for what only a screen shows."""
    match event:
        case StationStatus(state=state, detail=detail):
            return f"station   {state}  {detail}".rstrip()
        case DeviceStatus(device=device, state=state, detail=detail):
            return f"{device:<9} {state}  {detail}".rstrip()
        case PartStarted(serial=serial, record_no=record_no, views=views):
            return f"part      {serial}  record {record_no}, {views} views"
        case ViewCaptured(index=index, total=total, angle_deg=angle_deg, points=points):
            return f"view      {index + 1}/{total} at {angle_deg:.2f} deg, {points} points"
        case VerdictReached():
            return verdict_line(event)
        case VerdictAcknowledged(serial=serial, code=code):
            return f"answer    {serial}  the PLC took it, code {code}"
        case AlarmRaised(number=number, text=text, action=action, state="UNACK" | "RETURNED"):
            return f"alarm     A{number:03d} {text}. {action}"
        case AlarmCleared(number=number):
            return f"alarm     A{number:03d} cleared"
        case LogLine(level="info" | "warning" | "error", text=text):
            return f"log       {text}"
    return None


def verdict_line(event: VerdictReached) -> str:
    """The one line of a verdict."""
    why = event.reasons[0] if event.reasons else ""
    return f"verdict   {event.serial}  {event.verdict}  {why}"


def print_line(event: Event) -> None:
    """Writes the line of an event to the standard error stream, one event one line."""
    line = line_of(event)
    if line is not None:
        sys.stderr.write(f"{printable(line)}\n")
        sys.stderr.flush()
