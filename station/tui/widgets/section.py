"""A section of the part: the profile with its limits, and the numbers beside it."""

from rich.text import Text
from textual.strip import Strip

from station.events import SectionMeasured, Value
from station.tui.canvas import Canvas, ascii_dots, braille
from station.tui.section_picture import Window, around, section_dots, whole
from station.tui.state import ScreenState
from station.tui.widgets.panel import Panel


def worst_first(sections: tuple[SectionMeasured, ...]) -> int:
    """The index of the section to show first: the one with the lowest share of measured values, else 0."""
    missing = [sum(value.value is None for value in section.values) for section in sections]
    return missing.index(max(missing)) if missing else 0


class SectionView(Canvas):
    """The whole section, or one edge of it (`edge` is "le" or "te")."""

    section: SectionMeasured | None = None

    def __init__(self, *, edge: str | None = None, id: str | None = None) -> None:  # noqa: A002
        super().__init__(id=id)
        self._edge = edge

    def show_section(self, section: SectionMeasured | None) -> None:
        if section is not self.section:
            self.section = section
            self.redraw()

    def draw(self, columns: int, rows: int) -> list[Strip]:
        if self.section is None:
            return []
        image = section_dots(self.section, self._window(self.section), columns, rows)
        return ascii_dots(image.dots) if self.glyphs == "ascii" else braille(image.dots, image.colours)

    def _window(self, section: SectionMeasured) -> Window:
        if self._edge is None:
            return whole(section)
        return around(section, section.le_mm if self._edge == "le" else section.te_mm, half_mm=2.5)


class SectionTitle(Panel):
    """Which section is shown, of how many, and how far deviations are magnified."""

    chosen: int = 0

    def text_of(self, state: ScreenState) -> Text:
        if not state.sections:
            return Text("SECTION", style="bold dim")
        section = state.sections[min(self.chosen, len(state.sections) - 1)]
        magnified = whole(section).magnification
        limit = "" if section.serviceable_mm is None else f"   limit {section.serviceable_mm:g} mm dashed"
        text = f"SECTION z {section.z_mm:g} mm  {section.status.upper()}   x{magnified:.0f}{limit}"
        return Text(text, style="bold")


def value_text(value: Value) -> Text:
    """One line: name, value with expanded digits, sigma, nominal; or why there is none."""
    text = Text(f" {value.name:<18}")
    if value.value is None:
        return text.append(f"not measured: {value.reason}"[:60], style="dim")
    text.append(f"{value.value:>10.4f}", style="bold").append(f" {value.unit:<4}")
    if value.sigma is not None:
        text.append(f" ±{value.sigma:.4f}", style="dim")
    if value.nominal is not None:
        text.append(f"  nominal {value.nominal:.3f}", style="dim")
    return text


class SectionValues(Panel):
    """The numbers of the chosen section."""

    chosen: int = 0

    def text_of(self, state: ScreenState) -> Text:
        if not state.sections:
            return Text("")
        section = state.sections[min(self.chosen, len(state.sections) - 1)]
        return Text("\n").join(value_text(value) for value in section.values)
