"""The operator screen: a client of the station's event stream. Closing it changes nothing in the cell."""

import os
import sys
from typing import ClassVar

from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.widget import Widget
from textual.widgets import Footer

from station.events import Acknowledge, Event, Intent, Reset, Start, Stop
from station.tui.canvas import Canvas
from station.tui.client import StreamClient
from station.tui.palette import DARK
from station.tui.screens import AlarmPage, HelpPage, Page, ResultPage, SectionPage
from station.tui.state import ScreenState, lost, step
from station.tui.widgets.alarms import AlarmBanner
from station.tui.widgets.blade import BladeCloud, CloudTitle, Legend
from station.tui.widgets.findings import Findings
from station.tui.widgets.panel import Panel
from station.tui.widgets.section import SectionTitle, SectionView, worst_first
from station.tui.widgets.status import Clock, Devices, HandshakeBits, Sequence, TopLine
from station.tui.widgets.verdict import Verdict, VerdictText

FRAME_S = 0.2  # the screen is redrawn at most five times a second, however fast events come


class OperatePage(Page):
    """The page that an operator looks at all day."""

    def compose(self) -> ComposeResult:
        with Horizontal(id="top"):
            yield TopLine()
            yield Clock()
        with Horizontal(id="body"):
            with Vertical(id="left"):
                yield Devices()
                yield HandshakeBits()
                yield Sequence()
            with Vertical(id="middle"):
                yield Verdict()
                yield VerdictText()
                yield CloudTitle()
                yield BladeCloud()
                yield Legend()
                yield Findings()
            with Vertical(id="right"):
                yield Verdict()
                yield VerdictText()
                yield SectionTitle()
                yield SectionView()
                yield Findings()
        yield AlarmBanner()
        yield Footer(show_command_palette=False, compact=True)

    def show(self, state: ScreenState) -> None:
        super().show(state)
        index = worst_first(state.sections)
        self.query_one(SectionTitle).chosen = index
        self.query_one(SectionView).show_section(state.sections[index] if state.sections else None)
        for widget in self.query(Widget):
            if isinstance(widget, Panel | Verdict | BladeCloud | Legend):
                widget.show(state)


class OperatorScreen(App[None]):
    """Keeps one state, fed by the stream, and hands it to the page on top."""

    CSS_PATH = "app.tcss"
    TITLE = "Bladecell"
    ENABLE_COMMAND_PALETTE = False
    HORIZONTAL_BREAKPOINTS = [(0, "-narrow"), (100, "-medium"), (150, "-wide")]  # noqa: RUF012
    VERTICAL_BREAKPOINTS = [(0, "-low"), (32, "-high")]  # noqa: RUF012
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("f1", "page('help')", "Help", priority=True),
        Binding("f2", "page('alarms')", "Alarms", priority=True),
        Binding("f3", "acknowledge", "Ack", priority=True),
        Binding("f4", "start", "Start", priority=True),
        Binding("f9", "reset", "Reset", priority=True),
        Binding("f12", "stop", "STOP SEQUENCE", priority=True),
        Binding("f5", "page('results')", "Results", priority=True),
        Binding("f6", "page('section')", "Section", priority=True),
        Binding("ctrl+q", "quit", "Close screen", priority=True, show=False),
    ]
    PAGES: ClassVar[dict[str, type[Page]]] = {
        "help": HelpPage,
        "alarms": AlarmPage,
        "results": ResultPage,
        "section": SectionPage,
    }

    def __init__(self, host: str, port: int, *, view_only: bool = False) -> None:
        super().__init__()
        self.state = ScreenState()
        self._dirty = True
        self._view_only = view_only
        self._client = StreamClient(host, port, self.take, self.lose)

    def get_default_screen(self) -> Page:
        return OperatePage()

    def on_mount(self) -> None:
        self.register_theme(DARK)
        self.theme = DARK.name
        self.set_interval(FRAME_S, self.refresh_page)
        self.set_interval(1.0, self._mark_dirty)
        self.run_worker(self._client.follow(), exclusive=True)

    def take(self, event: Event) -> None:
        """One event of the stream; one that cannot be shown is dropped, the screen goes on."""
        try:
            self.state = step(event, self.state)
        except ValueError as error:
            self.log.warning(f"event dropped: {error}")
        self._mark_dirty()

    def lose(self) -> None:
        """The stream ended."""
        self.state = lost(self.state)
        self._mark_dirty()

    def _mark_dirty(self) -> None:
        self._dirty = True

    def refresh_page(self) -> None:
        """Show the state, if it changed since the last frame."""
        if self._dirty and isinstance(self.screen, Page) and self.screen.is_mounted:
            self._dirty = False
            self.screen.show(self.state)

    def action_page(self, name: str) -> None:
        kind = self.PAGES[name]
        if isinstance(self.screen, kind):
            self.pop_screen()
        elif isinstance(self.screen, OperatePage):
            self.push_screen(kind())
        else:
            self.switch_screen(kind())
        self._mark_dirty()

    def on_screen_resume(self) -> None:
        self._mark_dirty()

    def action_acknowledge(self) -> None:
        self._ask(Acknowledge(), "acknowledge")

    def action_start(self) -> None:
        self._ask(Start(), "start")

    def action_reset(self) -> None:
        self._ask(Reset(), "reset")

    def action_stop(self) -> None:
        self._ask(Stop(), "STOP SEQUENCE")

    def _ask(self, intent: Intent, name: str) -> None:
        if self._view_only:
            self.notify(f"{name}: this screen only looks", markup=False)
        elif self._client.send(intent):
            self.notify(f"{name}: sent to the station", timeout=2.0, markup=False)
        else:
            self.notify(f"{name}: NOT SENT, the station is not heard", severity="warning", markup=False)


def choose_glyphs(asked: str | None, environment: dict[str, str]) -> str:
    """`blocks` or `ascii`: what was asked for, else ascii on the Linux console and without UTF-8."""
    if asked in ("blocks", "ascii"):
        return asked
    encoding = environment.get("LC_ALL") or environment.get("LC_CTYPE") or environment.get("LANG") or ""
    poor = environment.get("TERM") in ("linux", "dumb") or ("UTF" not in encoding.upper() and encoding != "")
    return "ascii" if poor else "blocks"


def main(host: str, port: int, *, view_only: bool = False, glyphs: str | None = None) -> None:
    """Run the screen until it is closed."""
    Canvas.glyphs = choose_glyphs(glyphs, dict(os.environ))
    if not sys.stdout.isatty():
        raise SystemExit("the operator screen needs a terminal")
    OperatorScreen(host, port, view_only=view_only).run()
