"""A measurement as JSON, and where two of them differ. Every number is kept; long arrays by their length."""

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from math import isfinite
from typing import Any

import numpy as np

LONGEST_ARRAY = 36
TOLERANCE = 1e-9
NOT_COMPARED = frozenset({"timing_s"})


def numbers(value: Any) -> Any:
    """The JSON of a result of geometry; a number that is not finite becomes its name."""
    if is_dataclass(value) and not isinstance(value, type):
        return {each.name: numbers(getattr(value, each.name)) for each in fields(value)}
    if isinstance(value, np.ndarray):
        small = value.size <= LONGEST_ARRAY
        return numbers(value.tolist()) if small else {"length": list(value.shape)}
    if isinstance(value, Mapping):
        return {str(key): numbers(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [numbers(item) for item in value]
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, float | np.floating):
        return float(value) if isfinite(value) else repr(float(value))
    return value.item() if isinstance(value, np.generic) else value


def differences(recorded: Any, again: Any, where: str = "") -> Iterator[str]:
    """Each place where two such documents differ by more than TOLERANCE, relative above 1."""
    if isinstance(recorded, dict) and isinstance(again, dict):
        for key in sorted(recorded.keys() | again.keys()):
            if key not in NOT_COMPARED:
                yield from differences(recorded.get(key), again.get(key), f"{where}.{key}".lstrip("."))
    elif isinstance(recorded, list) and isinstance(again, list) and len(recorded) == len(again):
        for index, (one, other) in enumerate(zip(recorded, again, strict=True)):
            yield from differences(one, other, f"{where}[{index}]")
    elif not _equal(recorded, again):
        yield f"{where}: recorded {_short(recorded)}, now {_short(again)}"


def _equal(one: Any, other: Any) -> bool:
    numeric = isinstance(one, int | float) and isinstance(other, int | float)
    if numeric and not isinstance(one, bool) and not isinstance(other, bool):
        return abs(one - other) <= TOLERANCE * max(1.0, abs(one))
    return type(one) is type(other) and bool(one == other)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
