"""Linear algebra stays on one thread while a verb of the geometry runs, and is given back after."""

import scipy.linalg  # noqa: F401  its BLAS is another than numpy's
from threadpoolctl import threadpool_info, threadpool_limits

from geometry.threads import one_blas_thread


def threads() -> list[int]:
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


def test_blas_has_one_thread_inside_and_its_own_number_after():
    with threadpool_limits(limits=2, user_api="blas"):
        before = threads()
        inside = one_blas_thread(threads)()
        assert before == threads()
    assert inside
    assert set(inside) == {1}
