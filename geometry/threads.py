"""Linear algebra on the caller's own thread."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

P = ParamSpec("P")
T = TypeVar("T")


def one_blas_thread(verb: Callable[P, T]) -> Callable[P, T]:
    """The verb with BLAS kept to one thread while it runs.

    The matrices here are small: more threads wait for each other actively, and take the cores from the
    threads that have work. Sums in one order also make the same numbers whatever the number of cores.
    """

    @wraps(verb)
    def kept(*args: P.args, **kwargs: P.kwargs) -> T:
        with threadpool_limits(limits=1, user_api="blas"):
            return verb(*args, **kwargs)

    return kept
