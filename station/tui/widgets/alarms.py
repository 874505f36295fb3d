"""The permanent alarm line and the alarm list."""

from rich.text import Text

from station.tui.palette import PRIORITY_CODE, PRIORITY_COLOUR
from station.tui.state import ScreenState
from station.tui.widgets.panel import Panel


class AlarmBanner(Panel):
    """The most urgent, oldest unacknowledged alarm and how many more there are."""

    def text_of(self, state: ScreenState) -> Text:
        if not state.alarms:
            return Text(" no alarm", style="dim")
        first = state.alarms[0]
        unseen = first.state in ("UNACK", "RETURNED")
        look = f"bold{' reverse' if unseen else ''} {PRIORITY_COLOUR[first.priority]}"
        text = Text(" ").append(f" {PRIORITY_CODE[first.priority]}  {first.state} ", style=look)
        text.append(f"  A{first.number:03d}  {first.text}", style="bold").append(f"  - {first.action}")
        if len(state.alarms) > 1:
            text.append(f"   +{len(state.alarms) - 1} more: F2", style="dim")
        return text.append("   F3 acknowledge", style="dim") if unseen else text


class AlarmList(Panel):
    """Every alarm with what to do; the cause of a stop is marked."""

    def text_of(self, state: ScreenState) -> Text:
        text = Text()
        text.append("ALARMS\n\n", style="bold")
        if not state.alarms:
            return text.append("none", style="dim")
        for alarm in state.alarms:
            cause = "  FIRST CAUSE" if alarm.first_out else ""
            code = f"{PRIORITY_CODE[alarm.priority]:<12}{alarm.state:<9}"
            text.append(code, style=f"bold {PRIORITY_COLOUR[alarm.priority]}")
            text.append(f" A{alarm.number:03d}  {alarm.text}{cause}\n", style="bold")
            text.append(f"{'':22}{alarm.at_utc}   {alarm.action}\n\n")
        return text
