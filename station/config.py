"""station.toml, one cell: addresses, deadlines, where the record lives, which recipe is which plan."""

from datetime import UTC, datetime
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Literal, Self

from platformdirs import user_config_path
from pydantic import AwareDatetime, Field, PrivateAttr, StringConstraints, model_validator

from station.tomlfile import (
    BadFile,
    Flag,
    NonNegative,
    Port,
    Positive,
    Row,
    Settings,
    Text,
    Whole,
    read_settings,
)

Mode = Literal["PRODUCTION", "STUDY", "MAINTENANCE", "SIMULATION"]
RecipeNumber = Annotated[str, StringConstraints(pattern=r"^[1-9][0-9]{0,4}$")]

DEFAULT_PLACES = (Path("config/station.toml"), user_config_path("bladecell") / "station.toml")


class BadConfig(BadFile):
    """A station or calibration file that contradicts itself or cannot be read."""


class Turntable(Settings):
    port: Text
    baud: Annotated[Whole, Field(gt=0)] = 115200
    address: Annotated[Whole, Field(ge=1, le=99)] = 1
    reply_timeout_s: Positive = 0.5
    settle_s: NonNegative = 0.05
    position_tolerance_deg: Positive = 0.01


class Scanner(Settings):
    host: Text
    modbus_port: Port = 502
    control_port: Port = 3190
    data_port: Port = 3196
    serial: Whole
    capture_timeout_s: Positive = 30.0


class Plc(Settings):
    listen_host: Text
    port: Port = 502
    heartbeat_timeout_s: Positive = 2.0
    accept_crc_zero: Flag = True


class Record(Settings):
    directory: Text


class Events(Settings):
    host: Text = "127.0.0.1"
    port: Port = 15600


class CalibrationChoice(Settings):
    file: Text
    max_age_days: Positive


class DailyCheckChoice(Settings):
    """A cell that is to be checked with a ball bar every day; without this table it is not."""

    file: Text
    max_age_h: Positive = 24.0
    max_error_mm: Positive


class Worker(Settings):
    timeout_s: Positive = 180.0


class StationConfig(Settings):
    """One cell, as its file says it. Relative paths are relative to that file."""

    schema_: Annotated[Literal["bladecell.station/1"], Field(alias="schema")]
    station_id: Text
    mode: Mode
    turntable: Turntable
    scanner: Scanner
    plc: Plc
    record: Record
    events: Events = Events()
    calibration: CalibrationChoice
    daily_check: DailyCheckChoice | None = None
    worker: Worker = Worker()
    recipes: Annotated[dict[RecipeNumber, Text], Field(min_length=1)]
    _path: Path = PrivateAttr(default=Path("station.toml"))

    def model_post_init(self, context: dict[str, Path] | None) -> None:
        if context:
            self._path = context["path"]

    @property
    def path(self) -> Path:
        """The file that this configuration was read from."""
        return self._path

    @property
    def record_directory(self) -> Path:
        """Where the record and the job folders live."""
        return self.beside(self.record.directory)

    @property
    def calibration_path(self) -> Path:
        """The calibration of the turntable axis in the scanner."""
        return self.beside(self.calibration.file)

    @property
    def daily_check_path(self) -> Path | None:
        """The newest check with an artefact, or None where the cell needs none."""
        return None if self.daily_check is None else self.beside(self.daily_check.file)

    def plan_path(self, recipe: int) -> Path | None:
        """The plan of a recipe number, or None when the cell does not know that number."""
        name = self.recipes.get(str(recipe))
        return None if name is None else self.beside(name)

    def beside(self, name: str) -> Path:
        """A path of this file, relative to its folder."""
        return (self._path.parent / name).resolve()

    @model_validator(mode="after")
    def guarded(self) -> Self:
        if not is_loopback(self.events.host):
            raise ValueError("events.host: the event stream takes commands and serves this machine only")
        for where, host in self.peers() if self.mode == "SIMULATION" else ():
            if not is_loopback(host):
                raise ValueError(f'{where}: mode SIMULATION refuses "{host}", which is not this machine')
        return self

    def peers(self) -> list[tuple[str, str]]:
        """Every other end that this configuration names, with the key that names it."""
        peers = [("scanner.host", self.scanner.host), ("plc.listen_host", self.plc.listen_host)]
        scheme, _, rest = self.turntable.port.partition("://")
        if rest:
            peers.append(("turntable.port", rest.rpartition(":")[0] if scheme == "socket" else rest))
        return peers


def is_loopback(host: str) -> bool:
    """Whether `host` is this machine, without asking a name server."""
    try:
        return ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


class Calibration(Settings):
    """Where the turntable's axis lies in the scanner, when it was found and how well."""

    schema_: Annotated[Literal["bladecell.calibration/1"], Field(alias="schema")]
    created_utc: AwareDatetime
    T_scanner_table0: tuple[Row, Row, Row, Row]
    sigma_axis_offset_mm: NonNegative
    sigma_axis_tilt_deg: NonNegative
    scanner_serial: Whole

    def age_days(self, now: datetime) -> float:
        """Days since the calibration; negative when it lies in the future."""
        return (now.astimezone(UTC) - self.created_utc).total_seconds() / 86_400.0


def read_config(path: Path) -> StationConfig:
    """The configuration that `path` holds; raises `BadConfig`. No other file is opened."""
    return read_settings(path, StationConfig, BadConfig)


def read_calibration(path: Path) -> Calibration:
    """The calibration that `path` holds; raises `BadConfig`."""
    return read_settings(path, Calibration, BadConfig)


def find_config(given: Path | None) -> Path:
    """The configuration file that is meant; raises `BadConfig` when none is given and none lies in place."""
    if given is not None:
        return given
    found = next((path for path in DEFAULT_PLACES if path.is_file()), None)
    if found is None:
        raise BadConfig(DEFAULT_PLACES[0], f"no configuration here nor at {DEFAULT_PLACES[1]}; give --config")
    return found
