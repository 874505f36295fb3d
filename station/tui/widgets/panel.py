"""A panel that is handed the state: text panels are rebuilt only when their text changes."""

from rich.text import Text
from textual.widgets import Static

from station.tui.state import ScreenState


class Panel(Static):
    """A block of text drawn from the state. Text is `rich.text.Text`: nothing in it is markup."""

    def __init__(self, *, id: str | None = None, classes: str | None = None) -> None:  # noqa: A002
        super().__init__("", id=id, classes=classes, markup=False)
        self._shown: Text | None = None

    def text_of(self, state: ScreenState) -> Text:
        """What to show for this state, which each panel says: a widget's metaclass leaves no room for ABC."""
        raise NotImplementedError

    def show(self, state: ScreenState) -> None:
        """Show the state; a fault in it costs this panel's text, never the screen."""
        try:
            text = self.text_of(state)
        except Exception as error:
            text = Text(f"cannot show {type(self).__name__}: {error}", style="bold")
        if self._shown is None or text != self._shown or text.spans != self._shown.spans:
            self._shown = text
            self.update(text)
