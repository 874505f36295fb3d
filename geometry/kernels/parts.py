"""Long arrays in parts, a thread for each: kernels let go of the interpreter's lock while they run."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numba

T = TypeVar("T")

LEAST = 50_000  # items that are worth a thread


def threads_for(count: int) -> int:
    """How many threads `count` items are worth: no more than numba is given."""
    return max(1, min(int(numba.config.NUMBA_NUM_THREADS), count // LEAST))


def over_parts(work: Callable[[int, int], T], count: int) -> list[T]:
    """What `work` gives for each part, from its first item to before its last, of `count` items in order.

    There is a thread for each part. The work on an item must not depend on where the parts begin: then no
    number of threads changes a result.
    """
    parts = threads_for(count)
    if parts == 1:
        return [work(0, count)]
    bounds = [count * part // parts for part in range(parts + 1)]
    with ThreadPoolExecutor(parts) as pool:
        return list(pool.map(work, bounds[:-1], bounds[1:]))
