"""The cloud of the part and the legend of its colours."""

import numpy as np
from rich.segment import Segment
from rich.text import Text
from textual.strip import Strip

from station.tui.blade_picture import two_sides
from station.tui.canvas import Canvas, ascii_shades, half_blocks, style
from station.tui.palette import BANDS, DIM, FIELD, OVER, UNDER
from station.tui.state import CloudPicture, ScreenState
from station.tui.widgets.panel import Panel


class BladeCloud(Canvas):
    """Both sides of the blade; grows while views arrive, shows deviations once they are measured."""

    cloud: CloudPicture | None = None

    def show(self, state: ScreenState) -> None:
        if state.cloud is not self.cloud:
            self.cloud = state.cloud
            self.redraw()

    def draw(self, columns: int, rows: int) -> list[Strip]:
        pixels = two_sides(self.cloud, columns, 2 * rows)
        return ascii_shades(pixels) if self.glyphs == "ascii" else half_blocks(pixels)


class CloudTitle(Panel):
    def text_of(self, state: ScreenState) -> Text:
        if state.cloud is None:
            return Text("POINT CLOUD", style="bold dim")
        shown = f"{len(state.cloud.points_mm):,} points shown".replace(",", " ")
        angle = "" if state.angle_deg is None else f"   table {state.angle_deg:.1f} deg"
        if state.cloud.deviation_mm is None:
            return Text(f"POINT CLOUD  growing   {shown}{angle}", style="bold")
        return Text(f"DEVIATION FROM NOMINAL   both sides   {shown}", style="bold")


class Legend(Canvas):
    """The colours with their words and arrows; empty until a deviation is shown."""

    limit_mm: float | None = None

    def show(self, state: ScreenState) -> None:
        cloud = state.cloud
        limit_mm = None if cloud is None or cloud.deviation_mm is None else cloud.limit_mm
        if limit_mm != self.limit_mm:
            self.limit_mm = limit_mm
            self.redraw()

    def draw(self, columns: int, rows: int) -> list[Strip]:
        if self.limit_mm is None:
            return []
        colours = (UNDER, *BANDS, OVER)
        edges = np.linspace(0, columns, len(colours) + 1).astype(int)
        marks = ["▼", *[" "] * len(BANDS), "▲"]
        segments = [
            Segment(mark.center(b - a), style(0xFFFFFF, colour))
            for mark, colour, a, b in zip(marks, colours, edges[:-1], edges[1:], strict=True)
        ]
        return [Strip(segments, columns), self._words(columns)]

    def _words(self, columns: int) -> Strip:
        row = [" "] * columns
        words = ("UNDER", f"-{self.limit_mm:g} mm", "0", f"+{self.limit_mm:g} mm", "OVER")
        for word, share in zip(words, (0.0, 0.15, 0.5, 0.85, 1.0), strict=True):
            start = round(share * (columns - len(word)))
            row[start : start + len(word)] = list(word)
        return Strip([Segment("".join(row), style(DIM, FIELD))], columns)
