"""The daily check: a ball bar on the table shows whether axis, angles and scanner are what they were."""

from datetime import UTC, datetime
from typing import Annotated, Literal

from pydantic import AwareDatetime, Field

from station.config import BadConfig, StationConfig
from station.gates import Gate
from station.tomlfile import NonNegative, Number, Settings, Whole, read_settings


class DailyCheck(Settings):
    """What a check found; whether that is good enough is the configuration's word."""

    schema_: Annotated[Literal["bladecell.daily_check/1"], Field(alias="schema")]
    created_utc: AwareDatetime
    scanner_serial: Whole
    stray_mm: NonNegative  # largest distance of a ball from its mean place on the table
    length_error_mm: Number  # distance of the two balls less the certified one


def daily_gate(config: StationConfig, now: datetime) -> Gate:
    """Whether the newest check holds now. A cell that asks for none has this gate shut for good."""
    if config.daily_check is None or config.daily_check_path is None:
        return Gate(holds=True)
    try:
        check = read_settings(config.daily_check_path, DailyCheck, BadConfig)
    except BadConfig as error:
        return Gate(holds=False, reason=str(error))
    age_h = (now.astimezone(UTC) - check.created_utc).total_seconds() / 3600.0
    worst_mm = max(check.stray_mm, abs(check.length_error_mm))
    if check.scanner_serial != config.scanner.serial:
        return Gate(holds=False, reason=f"made with scanner {check.scanner_serial}")
    if not 0.0 <= age_h <= config.daily_check.max_age_h:
        return Gate(holds=False, reason=f"{age_h:.1f} h old, want 0 to {config.daily_check.max_age_h:g}")
    return Gate(
        holds=worst_mm <= config.daily_check.max_error_mm,
        reason=f"off by {worst_mm:.4f} mm, want at most {config.daily_check.max_error_mm:g} mm",
    )
