"""The benchmarks are no part of the suite but borrow from it: each must still find what it borrows."""

from importlib import import_module
from pathlib import Path

import pytest

NAMES = sorted(path.stem for path in (Path(__file__).parents[1] / "benchmarks").glob("[a-z]*.py"))


@pytest.mark.parametrize("name", NAMES)
def test_a_benchmark_finds_what_it_borrows(name: str) -> None:
    assert import_module(f"benchmarks.{name}").main
