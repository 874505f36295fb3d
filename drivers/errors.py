"""Whose fault it is, in the type.

    DriverError
    ├── LinkDown       the cable, the port or the far end is gone
    ├── Timeout        the link stands, the answer did not come in time
    ├── BadReply       an answer came that breaks the protocol or contradicts the request
    ├── DeviceFault    the device reports that it cannot, or shows that it did not
    └── Refused        the device understood and said no

Every text is one line that names the device and its port. `BadReply` is also what the codecs of
`drivers.wire` raise, without a port.
"""

from drivers.wire.errors import BadReply, DriverError


class LinkDown(DriverError):
    """The cable, the port or the far end is gone."""


class Timeout(DriverError):
    """The link stands, but the answer did not come in time."""


class DeviceFault(DriverError):
    """The device reports that it cannot go on, or its state shows that it did not do as told."""


class Refused(DriverError):
    """The device understood the request and said no."""


__all__ = ["BadReply", "DeviceFault", "DriverError", "LinkDown", "Refused", "Timeout"]
