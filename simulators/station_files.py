"""The files that a simulated cell comes with: its station's configuration, calibration and recipe."""

import json
import random
import shutil
import socket
from dataclasses import dataclass
from pathlib import Path

# Below the range from which outgoing connections take theirs: a client that waits for its server on such
# a port would one day be connected to itself.
_FREE_PORTS = range(20_000, 30_000)

_STATION = """\
schema = "bladecell.station/1"
station_id = "CELL-1"
mode = "SIMULATION"

[turntable]
port = {turntable}
baud = 115200
address = 1
reply_timeout_s = 0.5
settle_s = 0.05
position_tolerance_deg = 0.01

[scanner]
host = "{at.host}"
modbus_port = {at.modbus}
control_port = {at.control}
data_port = {at.data}
serial = {serial}
capture_timeout_s = 30.0

[plc]
listen_host = "{at.host}"
port = {at.station_modbus}
heartbeat_timeout_s = 2.0
accept_crc_zero = true

[record]
directory = "record"

[events]
host = "{at.host}"
port = {at.events}

[calibration]
file = {calibration}
max_age_days = 3650

[worker]
timeout_s = 180.0

[recipes]
1 = {plan}
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Addresses:
    """Where the parts of the cell listen, and where its station will."""

    host: str
    turntable_tcp: int
    turntable_pty: str | None  # None: that end is left to somebody else
    modbus: int
    control: int
    data: int
    station_modbus: int
    events: int

    def line(self) -> str:
        """The one line of JSON that says so."""
        return json.dumps(
            {
                "turntable": {"tcp": f"{self.host}:{self.turntable_tcp}", "pty": self.turntable_pty},
                "scanner": {
                    "modbus": f"{self.host}:{self.modbus}",
                    "control": f"{self.host}:{self.control}",
                    "data": f"{self.host}:{self.data}",
                },
                "station_modbus": f"{self.host}:{self.station_modbus}",
            }
        )


def free_port(host: str) -> int:
    """A port on which nobody listens now."""
    for port in random.SystemRandom().sample(_FREE_PORTS, 200):
        with socket.socket() as probe:
            try:
                probe.bind((host, port))
            except OSError:
                continue
        return port
    raise OSError(f"no free port at {host} in {_FREE_PORTS.start}-{_FREE_PORTS.stop - 1}")


def write_station(path: Path, addresses: Addresses, scanner_serial: int, calibration: str, plan: str) -> None:
    """Write the station configuration for these addresses; paths are relative to it."""
    turntable = addresses.turntable_pty or f"socket://{addresses.host}:{addresses.turntable_tcp}"
    text = _STATION.format(
        at=addresses,
        turntable=json.dumps(turntable),
        serial=scanner_serial,
        calibration=json.dumps(calibration),
        plan=json.dumps(plan),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def copy_inputs(job: Path, folder: Path) -> tuple[str, str]:
    """Copy what a recorded job was measured with; gives calibration and plan, relative to `folder`.

    Raises `OSError`, `ValueError` or `KeyError` for a job whose inputs.json does not lead to them.
    """
    rows = json.loads((job / "inputs.json").read_text())
    for row in rows.values():
        target = folder / "replayed" / row["file"]
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(job / row["file"], target)
    return f"replayed/{rows['calibration']['file']}", f"replayed/{rows['plan']['file']}"
