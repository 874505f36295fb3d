"""Bytes to terminated lines, whatever way the bytes arrive.

Only a line whose terminator was seen is a line: a partial one never comes out. A line longer than
the cap is dropped up to its terminator, so that a flood of bytes costs no memory.
"""

from dataclasses import dataclass, field

TERMINATORS = b"\r\n"


@dataclass(slots=True)
class LineSplitter:
    """Cuts a byte stream at CR or LF; empty lines vanish, lines over `cap` bytes are counted and dropped."""

    cap: int = 256
    dropped: int = 0
    _tail: bytearray = field(default_factory=bytearray)
    _skipping: bool = False

    def feed(self, data: bytes) -> list[bytes]:
        """The lines completed by `data`, without their terminators."""
        lines: list[bytes] = []
        for piece in data.replace(b"\r", b"\n").splitlines(keepends=True):
            self._take(piece, lines)
        return lines

    def _take(self, piece: bytes, lines: list[bytes]) -> None:
        ended = piece.endswith(b"\n")
        if not self._skipping:
            self._tail += piece.rstrip(b"\n")
        if len(self._tail) > self.cap:
            self._skipping = True
            self.dropped += 1
            self._tail.clear()
        if ended:
            if self._tail and not self._skipping:
                lines.append(bytes(self._tail))
            self._tail.clear()
            self._skipping = False
