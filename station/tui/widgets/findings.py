"""The judged characteristics, worst first, each with its place between the limits."""

from rich.text import Text

from station.events import FindingRow
from station.tui.state import ScreenState
from station.tui.widgets.panel import Panel

BAR = 12
NAME = 26
MARK = {"PASS": " ", "REPAIR": "▲", "SCRAP": "✖", "HOLD": "?", "NOT_JUDGED": "·"}
LOOK = {
    "PASS": "",
    "REPAIR": "bold #e8b030",
    "SCRAP": "bold #ff5a36",
    "HOLD": "bold #b0a0d8",
    "NOT_JUDGED": "dim",
}


def limit_bar(finding: FindingRow) -> str:
    """A bar from 0 to the repairable limit: `┼` the serviceable limit, `●` the judged value, `▶` beyond."""
    judged = finding.deviation if finding.deviation is not None else finding.value
    if judged is None or not finding.repairable or finding.serviceable is None:
        return " " * BAR
    cells = ["─"] * BAR
    cells[min(BAR - 1, int(finding.serviceable / finding.repairable * BAR))] = "┼"
    share = abs(judged) / finding.repairable
    cells[min(BAR - 1, int(share * BAR))] = "▶" if share > 1.0 else "●"
    return "".join(cells)


class Findings(Panel):
    """As many findings as there are lines."""

    def text_of(self, state: ScreenState) -> Text:
        text = Text()
        text.append(f"   {'CHARACTERISTIC':<{NAME}}{'DEV':>8}  0{'limits':^{BAR - 2}}R\n", style="bold dim")
        if state.verdict_shown is None:
            return text
        for finding in state.verdict_shown.findings[: max(self.size.height - 1, 1)]:
            text.append_text(self._line(finding)).append("\n")
        return text

    @staticmethod
    def _line(finding: FindingRow) -> Text:
        judged = finding.deviation if finding.deviation is not None else finding.value
        number = "   --   " if judged is None else f"{judged:>+8.3f}"
        name = finding.characteristic.replace("sections[", "z ").replace("].", " ")[:NAME]
        line = f" {MARK.get(finding.outcome, '?')} {name:<{NAME}}{number}  {limit_bar(finding)}"
        return Text(line, style=LOOK.get(finding.outcome, ""))
