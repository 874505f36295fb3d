"""The top line, the devices, the handshake and the sequence: the left column of the operate screen."""

from datetime import UTC, datetime

from rich.text import Text

from station.events import DeviceStatus, Handshake
from station.tui.state import STEPS, ScreenState
from station.tui.widgets.panel import Panel

DEVICE_ORDER = ("turntable", "scanner", "plc", "worker", "record")
DEVICE_MARK = {
    "READY": ("●", ""),
    "BUSY": ("▶", "bold"),
    "CONNECTING": ("◌", "bold"),
    "OFFLINE": ("○", "bold #e8b030"),
    "FAULT": ("▲", "bold #ff5a36"),
}
PLC_BITS = ("ENABLE", "PART_PRESENT", "START", "RESULT_ACK", "ABORT", "RESET_FAULT", "PART_CHANGED")
STATION_BITS = ("ONLINE", "READY", "START_ACK", "BUSY", "RESULT_VALID", "FAULT", "PLC_LOST", "SAFE_TO_UNLOAD")
STEP_TEXT = {
    "scan": "Scan",
    "clean": "Clean and fuse",
    "register": "Register to nominal",
    "twin": "Damage-free twin",
    "damage": "Damages",
    "repair": "Repair volume",
    "sections": "Sections",
    "judge": "Verdict",
    "record": "Record",
}


class TopLine(Panel):
    """Station, mode, state, part; the time of this terminal."""

    def text_of(self, state: ScreenState) -> Text:
        text = Text(" ")
        if state.status is None:
            return text.append("NO STATION  waiting for the event stream", style="bold #e8b030")
        status = state.status
        text.append(status.station_id, style="bold").append(" │ ")
        mode_style = "bold" if status.mode == "PRODUCTION" else "bold #e8b030"
        text.append(status.mode, style=mode_style).append(" │ ").append(status.state, style="bold")
        if state.part is not None:
            text.append(" │ part ").append(state.part.serial, style="bold")
            text.append(f"  {state.part.part_number}  recipe {state.part.recipe}  #{state.part.record_no}")
        if status.detail:
            text.append(f" │ {status.detail}")
        return text


class Clock(Panel):
    """The time, and whether the station is heard."""

    def text_of(self, state: ScreenState) -> Text:
        now = datetime.now(UTC).astimezone()
        heart = Text("♥ ", style="") if state.live else Text("STALE ", style="bold reverse #e8b030")
        return heart.append(now.strftime("%H:%M:%S "))


class Devices(Panel):
    def text_of(self, state: ScreenState) -> Text:
        text = Text("DEVICES\n", style="")
        text.stylize("bold")
        for name in DEVICE_ORDER:
            device = state.devices.get(name, DeviceStatus(device=name, state="OFFLINE"))
            mark, look = DEVICE_MARK[device.state]
            text.append(f" {mark} {name:<10}{device.state:<11}{device.detail}"[:35] + "\n", style=look)
        return text


class HandshakeBits(Panel):
    """The two words of the handshake, a filled square for a bit that is set."""

    def text_of(self, state: ScreenState) -> Text:
        shake = state.handshake or Handshake(
            plc_bits=(), station_bits=(), sequence=0, plc_heartbeat=0, station_heartbeat=0
        )
        text = Text()
        text.append(f"{'PLC':<17}{'STATION'}\n", style="bold")
        for row in range(max(len(PLC_BITS), len(STATION_BITS))):
            self._bit(text, PLC_BITS, row, shake.plc_bits)
            self._bit(text, STATION_BITS, row, shake.station_bits)
            text.append("\n")
        alive, look = ("alive", "") if shake.plc_alive else ("SILENT", "bold #e8b030")
        text.append(f" {alive} {shake.plc_heartbeat:<9}", style=look)
        text.append(f"beat {shake.station_heartbeat}\n sequence {shake.sequence}\n")
        return text

    @staticmethod
    def _bit(text: Text, names: tuple[str, ...], row: int, set_bits: tuple[str, ...]) -> None:
        if row >= len(names):
            text.append(" " * 17)
            return
        on = names[row] in set_bits
        urgent = on and names[row] in ("FAULT", "PLC_LOST", "ABORT")
        look = "bold #ff5a36" if urgent else "bold" if on else "dim"
        text.append(f" {'■' if on else '□'} {names[row]:<14}", style=look)


class Sequence(Panel):
    """The steps of the procedure: done, running, to come; and how many views there are."""

    def text_of(self, state: ScreenState) -> Text:
        text = Text()
        text.append("SEQUENCE\n", style="bold")
        for number, name in enumerate(STEPS, 1):
            label = STEP_TEXT[name]
            if name == "scan" and state.part is not None:
                label = f"Scan {state.views_done}/{state.part.views} views"
            self._line(text, number, name, label, state)
        return text.append_text(self._progress(state))

    @staticmethod
    def _line(text: Text, number: int, name: str, label: str, state: ScreenState) -> None:
        if name in state.durations_s:
            text.append(f" ✔ {number} {label:<22}{state.durations_s[name]:>6.1f} s\n")
        elif state.step == name:
            text.append(f" ▶ {number} {label:<30}\n", style="bold reverse")
        else:
            text.append(f" · {number} {label}\n", style="dim")

    @staticmethod
    def _progress(state: ScreenState) -> Text:
        done = sum(name in state.durations_s for name in STEPS)
        if state.part is not None and state.step == "scan" and state.part.views:
            share = state.views_done / state.part.views / len(STEPS)
        else:
            share = done / len(STEPS)
        width = 27
        filled = round(share * width)
        return Text(" " + "━" * filled).append("─" * (width - filled), style="dim").append(f" {share:>4.0%}")
