"""Linear algebra on the caller's own thread."""

from collections.abc import Callable
from functools import cache, wraps
from typing import ParamSpec, TypeVar

import scipy.linalg  # noqa: F401  brings a BLAS of its own
from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
T = TypeVar("T")


def one_blas_thread(verb: Callable[P, T]) -> Callable[P, T]:
    """The verb with BLAS kept to one thread while it runs.

    The matrices here are small: more threads wait for each other actively, and take the cores from the
    threads that have work. Sums in one order also make the same numbers whatever the number of cores.
    """

    @wraps(verb)
    def kept(*args: P.args, **kwargs: P.kwargs) -> T:
        with _libraries().limit(limits=1, user_api="blas"):
            return verb(*args, **kwargs)

    return kept


@cache
def _libraries() -> ThreadpoolController:
    """Those loaded by the first call, numpy's and scipy's among them: to look for them takes milliseconds."""
    return ThreadpoolController()
