"""The configuration that ships is valid; one that is not stops the start with the key named."""

from datetime import UTC, datetime
from pathlib import Path

import pytest

from station import config as module
from station.config import BadConfig, StationConfig, find_config, is_loopback, read_calibration, read_config

SHIPPED = Path(__file__).resolve().parents[2] / "config" / "station.toml"

CALIBRATION = """\
schema = "bladecell.calibration/1"
created_utc = "2026-03-01T08:00:00Z"
T_scanner_table0 = [[1.0, 0, 0, 5], [0, 1, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]
sigma_axis_offset_mm = 0.003
sigma_axis_tilt_deg = 0.002
scanner_serial = 93111
"""


def simulated() -> str:
    """The shipped file as a cell on this machine would have it."""
    text = SHIPPED.read_text(encoding="utf-8").replace("PRODUCTION", "SIMULATION", 1)
    return text.replace("192.168.1.10", "127.0.0.1").replace("192.168.2.10", "127.0.0.1")


def read(folder: Path, text: str) -> StationConfig:
    (folder / "station.toml").write_text(text, encoding="utf-8")
    return read_config(folder / "station.toml")


def test_the_shipped_configuration_shows_every_key() -> None:
    config = read_config(SHIPPED)
    assert config.mode == "PRODUCTION"
    assert config.plan_path(1) == SHIPPED.parent / "blades/example/plan.toml"
    assert config.plan_path(2) is None
    assert config.record_directory == SHIPPED.parent.parent / "record"
    assert config.calibration_path == SHIPPED.parent / "calibration.toml"
    text = SHIPPED.read_text(encoding="utf-8")
    for table in (config, config.turntable, config.scanner, config.plc, config.events, config.worker):
        names = [field.alias or name for name, field in type(table).model_fields.items()]
        assert not [name for name in names if name not in text]


def test_simulation_refuses_peers_beyond_this_machine(tmp_path: Path) -> None:
    assert read(tmp_path, simulated()).mode == "SIMULATION"
    for key, there in (
        ("scanner.host", 'host = "127.0.0.1"\nmodbus_port'),
        ("plc.listen_host", 'listen_host = "127.0.0.1"'),
    ):
        elsewhere = simulated().replace(there, there.replace("127.0.0.1", "10.0.0.9"), 1)
        with pytest.raises(BadConfig, match=f"{key}: mode SIMULATION refuses"):
            read(tmp_path, elsewhere)
    port = "/dev/serial/by-id/usb-Zaber-turntable"
    read(tmp_path, simulated().replace(port, "socket://127.0.0.1:5"))
    with pytest.raises(BadConfig, match=r"turntable.port: mode SIMULATION refuses"):
        read(tmp_path, simulated().replace(port, "socket://10.0.0.9:5"))


def test_the_event_stream_stays_on_this_machine(tmp_path: Path) -> None:
    text = SHIPPED.read_text(encoding="utf-8").replace('host = "127.0.0.1"', 'host = "0.0.0.0"')
    with pytest.raises(BadConfig, match=r"events.host"):
        read(tmp_path, text)


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("station_id", "stationid", "station_id: is missing"),
        ('"PRODUCTION"', '"FAST"', "mode: Input should be"),
        ("port = 15600", "port = 70000", "events.port: "),
        ("max_age_days = 7", 'max_age_days = "7"', "calibration.max_age_days: "),
        ("address = 1 ", 'address = "1" ', "turntable.address: Input should be a valid integer"),
        ("serial = 93111", "serial = 93111.0", "scanner.serial: Input should be a valid integer"),
        ("accept_crc_zero = true", 'accept_crc_zero = "no"', "plc.accept_crc_zero: Input should be"),
        ('1 = "blades', '0 = "blades', "recipes.0: "),
        ('1 = "blades/example/plan.toml"', "", "recipes: "),
        ("timeout_s = 180.0", "timeout_s = inf", "worker.timeout_s: Input should be a finite number"),
    ],
)
def test_a_wrong_key_is_named(tmp_path: Path, old: str, new: str, what: str) -> None:
    text = SHIPPED.read_text(encoding="utf-8")
    assert old in text
    with pytest.raises(BadConfig) as caught:
        read(tmp_path, text.replace(old, new, 1))
    assert what in str(caught.value)


@pytest.mark.parametrize(
    ("host", "local"),
    [("127.0.0.1", True), ("::1", True), ("[::1]", True), ("localhost", True), ("0.0.0.0", False)],
)
def test_loopback_is_told_without_a_name_server(host: str, local: bool) -> None:
    assert is_loopback(host) is local
    assert not is_loopback("localhost.example.com")


def test_a_calibration_has_an_age(tmp_path: Path) -> None:
    path = tmp_path / "calibration.toml"
    path.write_text(CALIBRATION)
    calibration = read_calibration(path)
    assert calibration.T_scanner_table0[0] == (1.0, 0.0, 0.0, 5.0)
    assert calibration.age_days(datetime(2026, 3, 3, 20, tzinfo=UTC)) == 2.5
    path.write_text(CALIBRATION.replace('"2026-03-01T08:00:00Z"', "2026-03-01T09:00:00+01:00"))
    assert read_calibration(path).created_utc == calibration.created_utc


@pytest.mark.parametrize(
    ("old", "new"),
    [("08:00:00Z", "08:00:00"), ("[0, 0, 0, 1]", "[0, 0, 0]"), (", [0, 0, 0, 1]", ""), ("0.003", "-0.003")],
)
def test_a_bad_calibration_is_refused(tmp_path: Path, old: str, new: str) -> None:
    path = tmp_path / "calibration.toml"
    path.write_text(CALIBRATION.replace(old, new))
    with pytest.raises(BadConfig):
        read_calibration(path)


def test_the_configuration_is_looked_for_in_two_places(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    places = (tmp_path / "here.toml", tmp_path / "there.toml")
    monkeypatch.setattr(module, "DEFAULT_PLACES", places)
    with pytest.raises(BadConfig, match="no configuration here"):
        find_config(None)
    places[1].touch()
    assert find_config(None) == places[1]
    places[0].touch()
    assert find_config(None) == places[0]
    assert find_config(tmp_path / "given.toml") == tmp_path / "given.toml"
