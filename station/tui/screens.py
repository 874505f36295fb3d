"""The pages behind the operate screen: one section in full, the alarms, the results, the keys."""

from typing import ClassVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical, VerticalScroll
from textual.screen import Screen
from textual.widgets import DataTable, Footer, Static

from station.tui.palette import VERDICT_SHAPE
from station.tui.state import ScreenState
from station.tui.widgets.alarms import AlarmBanner, AlarmList
from station.tui.widgets.section import SectionTitle, SectionValues, SectionView, worst_first
from station.tui.widgets.status import Clock, TopLine

HELP = """\
BLADECELL OPERATOR SCREEN

 F1   this page              F2   alarms, what to do about each
 F3   acknowledge: "I have seen these alarms". Clears no cause.
 F4   start: home the table and become ready
 F5   results of the last parts
 F6   the sections of the present part, with both edges enlarged
 F9   reset: clear latched faults whose cause is gone
 F12  STOP SEQUENCE: ends the sequence, the part gets HOLD.
      It is not an emergency stop. The emergency stop is the red button.
 Esc  back to the operate page
 Ctrl+Q  close this screen. The cell goes on without it.

 VERDICTS                                        COLOURS OF THE CLOUD
 ✔ PASS    every limit met with certainty        blue  less material   brown  more material
 ▲ REPAIR  beyond serviceable, repairable        violet ▼ under the limit, pink ▲ over the limit
 ✖ SCRAP   proven beyond repair
 ? HOLD    not measured, or not certain: a person decides
"""


class Page(Screen[None]):
    """A page that shows the state it is given."""

    def content(self) -> ComposeResult:
        """The page's own widgets."""
        yield from ()

    def compose(self) -> ComposeResult:
        with Horizontal(id="top"):
            yield TopLine()
            yield Clock()
        yield from self.content()
        yield AlarmBanner()
        yield Footer(show_command_palette=False, compact=True)

    def show(self, state: ScreenState) -> None:
        """Hand the state to every widget that wants it."""
        for widget in (*self.query(TopLine), *self.query(Clock), *self.query(AlarmBanner)):
            widget.show(state)


class BackPage(Page):
    """A page behind the operate page."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("escape", "app.pop_screen", "Back")]


class SectionPage(BackPage):
    """One section over the whole width, its leading and trailing edge enlarged, its numbers."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("left", "step(-1)", "Previous"),
        Binding("right", "step(1)", "Next"),
    ]
    chosen: int | None = None
    state: ScreenState = ScreenState()

    def content(self) -> ComposeResult:
        yield SectionTitle()
        with Horizontal(id="body"):
            with Vertical():
                yield SectionView(id="whole")
                with Horizontal(id="edges"):
                    yield SectionView(edge="le", id="le")
                    yield SectionView(edge="te", id="te")
            with Vertical(id="numbers"):
                yield SectionValues()

    def on_mount(self) -> None:
        self.query_one("#le").border_title = "leading edge, 5 mm"
        self.query_one("#te").border_title = "trailing edge, 5 mm"

    def action_step(self, by: int) -> None:
        if self.state.sections:
            self.chosen = ((self.chosen or 0) + by) % len(self.state.sections)
            self.show(self.state)

    def show(self, state: ScreenState) -> None:
        super().show(state)
        self.state = state
        if self.chosen is None and state.sections:
            self.chosen = worst_first(state.sections)
        index = min(self.chosen or 0, max(len(state.sections) - 1, 0))
        for view in self.query(SectionView):
            view.show_section(state.sections[index] if state.sections else None)
        for panel in (self.query_one(SectionTitle), self.query_one(SectionValues)):
            panel.chosen = index
            panel.show(state)


class AlarmPage(BackPage):
    def content(self) -> ComposeResult:
        with VerticalScroll(id="page"):
            yield AlarmList()

    def show(self, state: ScreenState) -> None:
        super().show(state)
        self.query_one(AlarmList).show(state)


class ResultPage(BackPage):
    """The last parts, newest first."""

    _shown: tuple[object, ...] = ()

    def content(self) -> ComposeResult:
        yield DataTable(cursor_type="row")

    def on_mount(self) -> None:
        self.query_one(DataTable).add_columns("#", "serial", "verdict", "PLC", "UTC", "reason")

    def show(self, state: ScreenState) -> None:
        super().show(state)
        if state.records == self._shown:
            return
        self._shown = state.records
        table = self.query_one(DataTable)
        table.clear()
        for record in state.records:
            word = f"{VERDICT_SHAPE[record.verdict]} {record.verdict}"
            answer = "acknowledged" if record.acknowledged else "open"
            cells = (str(record.record_no), record.serial, word, answer, record.at_utc, record.reason)
            table.add_row(*(Text(cell) for cell in cells))


class HelpPage(BackPage):
    def content(self) -> ComposeResult:
        with VerticalScroll(id="page"):
            yield Static(Text(HELP), markup=False)
