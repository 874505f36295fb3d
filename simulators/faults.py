"""Seeded damage to what a device sends: lost, flipped, cut, late, or the line dropped altogether."""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class Delivery:
    """What becomes of one message: its bytes, how late, and whether the line drops after them."""

    data: bytes
    delay_s: float = 0.0
    hang_up: bool = False


@dataclass(slots=True, kw_only=True)
class Faults:
    """The share of messages that meet each fate, in the order in which they are tried."""

    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    drop: float = 0.0
    corrupt: float = 0.0
    truncate: float = 0.0
    disconnect: float = 0.0
    delay: float = 0.0
    delay_s: float = 1.0

    def __post_init__(self) -> None:
        shares = (self.drop, self.corrupt, self.truncate, self.disconnect, self.delay)
        if not all(0.0 <= share <= 1.0 for share in shares):
            raise ValueError(f"faults: {shares} are not shares of 0..1")

    def deliver(self, data: bytes) -> Delivery:
        """What becomes of `data`."""
        if self._meets(self.drop):
            return Delivery(data=b"")
        if data and self._meets(self.corrupt):
            data = self._flip(data)
        if data and self._meets(self.truncate):
            data = self._cut(data)
        if self._meets(self.disconnect):
            return Delivery(data=self._cut(data), hang_up=True)
        return Delivery(data=data, delay_s=self.delay_s if self._meets(self.delay) else 0.0)

    def _meets(self, share: float) -> bool:
        return share > 0.0 and self.rng.random() < share

    def _flip(self, data: bytes) -> bytes:
        at = int(self.rng.integers(len(data)))
        flipped = data[at] ^ (1 << int(self.rng.integers(8)))
        return data[:at] + bytes([flipped]) + data[at + 1 :]

    def _cut(self, data: bytes) -> bytes:
        return data[: int(self.rng.integers(len(data)))] if data else data
