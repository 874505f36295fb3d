"""Parts cover everything once, and their number changes nothing."""

import numba
import numpy as np
import pytest

from geometry.kernels import parts
from geometry.kernels.neighbours import k_nearest


@pytest.mark.parametrize("count", [0, 1, parts.LEAST, 3 * parts.LEAST + 7])
@pytest.mark.parametrize("threads", [1, 2, 5])
def test_parts_follow_each_other_and_leave_nothing_out(monkeypatch, count, threads):
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", threads)
    taken = parts.over_parts(np.arange, count)
    assert len(taken) <= threads
    assert np.array_equal(np.concatenate(taken), np.arange(count))


def test_neighbours_are_the_same_to_the_bit_for_any_number_of_threads(monkeypatch):
    monkeypatch.setattr(parts, "LEAST", 500)
    points = np.random.default_rng(1).normal(size=(4000, 3)) * [1.0, 1.0, 0.01]
    answers = []
    for threads in (1, 2, 7):
        monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", threads)
        answers.append(k_nearest(points, 9))
    for indices, distances in answers[1:]:
        assert np.array_equal(indices, answers[0][0])
        assert np.array_equal(distances, answers[0][1])
