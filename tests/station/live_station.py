"""The station as a program of its own, with the desk that needs no geometry: `CONFIG`."""

import asyncio
import sys
import time
from pathlib import Path

import recipe_desk

from station.cell import open_cell
from station.config import read_config
from station.operate import run_forever
from station.run import leave_on_signals


async def main(config: Path) -> None:
    async with open_cell(
        read_config(config),
        headless=True,
        version="test",
        clock=time.monotonic,
        on_event=lambda event: None,
        make_desk=recipe_desk.make,
    ) as cell:
        leave_on_signals(cell)
        await run_forever(cell)


if __name__ == "__main__":
    asyncio.run(main(Path(sys.argv[1])))
