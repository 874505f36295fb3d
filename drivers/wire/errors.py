"""The root of what can go wrong on a wire, and the one failure that a codec can know of.

`drivers.errors` draws the whole tree; these two live here because the codecs know no port.
"""

from typing import Self


class DriverError(Exception):
    """A failure of one device; its text is one line for a person: device, port, what happened."""

    def __init__(self, device: str, port: str, what: str) -> None:
        super().__init__(device, port, what)
        self.device = device
        self.port = port
        self.what = what

    def __str__(self) -> str:
        where = f"{self.device} on {self.port}" if self.port else self.device
        return f"{where}: {self.what}"

    def at(self, port: str) -> Self:
        """The same failure with the port that a codec could not name."""
        return type(self)(self.device, port, self.what)


class BadReply(DriverError):
    """The other end sent bytes or registers that break its protocol or contradict the request."""
