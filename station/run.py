"""`bladecell run`: the station against the addresses of its configuration, until SIGTERM.

`python -m station.run CONFIG` is the station that waits for an operator's START, without a screen.
"""

import asyncio
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

from drivers.errors import LinkDown
from geometry.errors import GeometryError
from station.cell import Cell, open_cell
from station.chain import RecordFailed
from station.config import find_config, read_config
from station.console import print_line
from station.events import Event
from station.operate import run_forever
from station.software import software_version
from station.tomlfile import BadFile

EXIT_OK, EXIT_FAILED, EXIT_USAGE = 0, 1, 2


def run(config: Path | None, *, headless: bool, on_event: Callable[[Event], None]) -> int:
    """The exit status of a station that ran until it was told to end: 2 for a bad configuration."""
    try:
        asyncio.run(operate_until_told(find_config(config), headless=headless, on_event=on_event))
    except BadFile as error:
        return complain(str(error), EXIT_USAGE)
    except (RecordFailed, LinkDown, GeometryError, OSError) as error:
        return complain(str(error), EXIT_FAILED)
    return EXIT_OK


async def operate_until_told(config: Path, *, headless: bool, on_event: Callable[[Event], None]) -> None:
    """Runs the station until SIGTERM, SIGINT or SIGHUP; a part on the table then gets HOLD."""
    settings, version = read_config(config), software_version()
    async with open_cell(
        settings, headless=headless, version=version, clock=time.monotonic, on_event=on_event
    ) as cell:
        leave_on_signals(cell)
        await run_forever(cell)


def leave_on_signals(cell: Cell) -> None:
    """Makes the signals of the system end the station in order."""
    loop = asyncio.get_running_loop()
    for name in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        loop.add_signal_handler(name, cell.leave)


def complain(text: str, status: int) -> int:
    """The exit status, after one line on the standard error stream."""
    sys.stderr.write(f"bladecell: {text.splitlines()[0]}\n")
    return status


if __name__ == "__main__":
    sys.exit(run(Path(sys.argv[1]), headless=False, on_event=print_line))
