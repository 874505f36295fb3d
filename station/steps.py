"""The steps of a long command on stderr: a bar on a terminal, plain lines elsewhere."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn


@contextmanager
def shown(steps: int) -> Iterator[Callable[[str], None]]:
    """What to call with the name of each step as it begins; about `steps` of them will come."""
    if not sys.stderr.isatty():
        yield plain
        return
    columns = (TextColumn("{task.description:<10}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task("read", total=steps)

        def advance(step: str) -> None:
            bars.update(task, description=step, advance=1)

        yield advance


def plain(step: str) -> None:
    """One line for one step."""
    sys.stderr.write(f"{step}\n")
    sys.stderr.flush()
