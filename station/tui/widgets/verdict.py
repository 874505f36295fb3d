"""The verdict: shape, word, colour; beneath it one sentence and what to do next."""

import numpy as np
from rich.text import Text
from textual.strip import Strip

from station.events import VerdictReached
from station.tui.canvas import Canvas, ascii_shades, half_blocks
from station.tui.letters import verdict_bitmap
from station.tui.palette import FIELD, VERDICT_FIELD, VERDICT_INK, VERDICT_SHAPE
from station.tui.state import ScreenState
from station.tui.widgets.panel import Panel

NEXT = {
    "PASS": "Part is serviceable. The PLC moves it on.",
    "REPAIR": "Send to repair.",
    "SCRAP": "Quarantine the part.",
    "HOLD": "No verdict. Hold the part; re-inspect or call quality.",
}
ROUTE = {"fill": "Send to repair: deposit the repair volume.", "rework": "Send to rework: no metal to add."}


class Verdict(Canvas):
    """The word as large as fits; without a present verdict it gives its room to the others."""

    verdict: str | None = None

    def on_mount(self) -> None:
        self.add_class("-absent")

    def show(self, state: ScreenState) -> None:
        shown = state.verdict_shown
        word = shown.verdict if shown is not None else None
        if word != self.verdict:
            self.verdict = word
            self.set_class(word is None, "-absent")
            self.redraw()

    def draw(self, columns: int, rows: int) -> list[Strip]:
        if self.verdict is None:
            return half_blocks(np.full((2 * rows, columns), FIELD, dtype=np.uint32))
        bitmap = verdict_bitmap(self.verdict, columns, 2 * rows)
        ink, field = VERDICT_INK[self.verdict], VERDICT_FIELD[self.verdict]
        pixels = np.where(bitmap, np.uint32(ink), np.uint32(field)).astype(np.uint32)
        if self.glyphs == "ascii":
            return ascii_shades(np.where(bitmap, np.uint32(0xFFFFFF), np.uint32(FIELD)).astype(np.uint32))
        return half_blocks(pixels)


class VerdictText(Panel):
    """The verdict in words: for which part, why, and the next action; or why there is none."""

    def text_of(self, state: ScreenState) -> Text:
        shown = state.verdict_shown
        if not state.live:
            return Text("STALE: the station is not heard. No verdict is present.", style="bold #e8b030")
        if shown is None:
            return self._without(state)
        text = Text()
        text.append(f"{VERDICT_SHAPE[shown.verdict]} {shown.verdict}", style="bold")
        text.append(f"  {shown.serial}  #{shown.record_no}{self._answer(state, shown)}\n", style="bold")
        for reason in shown.reasons[:2]:
            text.append(f"{reason}\n")
        return text.append(ROUTE.get(shown.route or "", NEXT[shown.verdict]), style="bold")

    @staticmethod
    def _without(state: ScreenState) -> Text:
        if state.part is not None and state.step is not None:
            return Text(f"Measuring {state.part.serial} ...", style="bold")
        return Text("No part measured yet.", style="dim")

    @staticmethod
    def _answer(state: ScreenState, shown: VerdictReached) -> str:
        answer = state.acknowledged
        if answer is None or answer.record_no != shown.record_no:
            return "  waiting for the PLC"
        return {1: "  routed by the PLC", 2: "  NOT ROUTED by the PLC", 3: "  overridden by people"}.get(
            answer.code, f"  PLC answered {answer.code}"
        )
