"""The exponential against the C library's."""

import numpy as np
import pytest

from geometry.kernels.decay import FARTHEST, decay


@pytest.mark.parametrize("farthest", [1.0, 10.0, 100.0, FARTHEST])
def test_it_is_the_exponential(farthest):
    rng = np.random.default_rng(1)
    places = np.concatenate([[0.0], rng.uniform(0.0, farthest, 2000)])
    np.testing.assert_allclose([decay(a) for a in places], np.exp(-places), rtol=1e-15)


def test_far_off_it_is_as_good_as_nothing():
    assert decay(1e9) == decay(FARTHEST) < 1e-303
    assert decay(np.inf) == decay(FARTHEST)
