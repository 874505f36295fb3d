"""Seeded damage does what its shares say, the same each time."""

import numpy as np
import pytest

from simulators.faults import Delivery, Faults

DATA = bytes(range(64))


def delivered(count: int = 2000, **shares: float) -> list[Delivery]:
    faults = Faults(rng=np.random.default_rng(1), **shares)
    return [faults.deliver(DATA) for _ in range(count)]


def test_without_faults_everything_arrives() -> None:
    assert delivered(5) == [Delivery(data=DATA)] * 5


def test_equal_seeds_do_equal_damage() -> None:
    shares = {"drop": 0.1, "corrupt": 0.2, "truncate": 0.2, "disconnect": 0.1, "delay": 0.1}
    assert delivered(200, **shares) == delivered(200, **shares)


@pytest.mark.parametrize("share", ["drop", "corrupt", "truncate", "disconnect", "delay"])
def test_each_fate_meets_its_share(share: str) -> None:
    """Four standard deviations of a binomial count of 2000 at 0.25 are 78."""
    hit = sum(delivery != Delivery(data=DATA) for delivery in delivered(**{share: 0.25}))
    assert abs(hit - 500) < 78


def test_what_each_fate_does() -> None:
    assert delivered(1, drop=1.0)[0].data == b""
    corrupt = delivered(1, corrupt=1.0)[0].data
    assert sum((a ^ b).bit_count() for a, b in zip(corrupt, DATA, strict=True)) == 1
    assert DATA.startswith(delivered(1, truncate=1.0)[0].data)
    assert len(delivered(1, truncate=1.0)[0].data) < len(DATA)
    assert delivered(1, disconnect=1.0)[0].hang_up
    assert delivered(1, delay=1.0)[0].delay_s == 1.0


def test_a_share_outside_0_to_1_is_refused() -> None:
    with pytest.raises(ValueError, match="shares"):
        Faults(drop=1.5)
