"""A TOML file as a frozen pydantic model, or one clear line: which file, where in it, what is wrong."""

import tomllib
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict, ValidationError

from station.refusal import Refusal

MAX_BYTES = 1_000_000
UNWRITTEN = ("every", "single", "[key]")  # parts of a location that no file spells


def printable(text: str) -> str:
    """`text`, unless it has control, bidirectional or other characters that a screen does not show."""
    if not text.isprintable():
        raise ValueError("has characters that cannot be printed")
    return text


Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Positive = Annotated[Number, Field(gt=0.0)]
NonNegative = Annotated[Number, Field(ge=0.0)]
Row = tuple[Number, Number, Number, Number]  # of a 4x4 motion
Text = Annotated[str, Strict(), Field(min_length=1, max_length=200), AfterValidator(printable)]
Whole = Annotated[int, Strict(), Field(ge=0)]
Port = Annotated[Whole, Field(ge=1, le=65535)]
Flag = Annotated[bool, Strict()]


class BadFile(Refusal):
    """A file that people wrote contradicts itself or cannot be read."""

    def __init__(self, path: Path, what: str, where: str = "") -> None:
        super().__init__(": ".join(part for part in (str(path), where, what) if part))
        self.path, self.what, self.where = path, what, where


class Settings(BaseModel):
    """A table of a TOML file: unknown keys are errors, nothing changes after reading."""

    model_config = ConfigDict(extra="forbid", frozen=True)


Model = TypeVar("Model", bound=BaseModel)


def read_settings(path: Path, model: type[Model], error: type[BadFile]) -> Model:
    """The TOML file `path` as `model`, which learns `path` as validation context; raises `error`."""
    try:
        return model.model_validate(read_table(path), context={"path": path})
    except ValidationError as bad:
        raise error(path, *first_fault(bad)) from bad
    except (OSError, ValueError, RecursionError) as bad:
        raise error(path, unreadable(bad)) from bad


def read_table(path: Path) -> dict[str, object]:
    """The parsed TOML of `path`."""
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"is larger than {MAX_BYTES} bytes")
    return tomllib.loads(path.read_text(encoding="utf-8"))


def unreadable(error: Exception) -> str:
    """Why a file is not a table, for a person."""
    match error:
        case OSError():
            return error.strerror or "cannot be read"
        case UnicodeDecodeError():
            return "is not UTF-8 text"
        case RecursionError():
            return "is nested too deeply"
        case tomllib.TOMLDecodeError():
            return f"is not TOML: {error}"
        case _:
            return str(error)


def first_fault(error: ValidationError) -> tuple[str, str]:
    """What is wrong with the first offending key, with the number of others, and where that key is."""
    first, *others = error.errors(include_url=False)
    more = f" (and {len(others)} more)" if others else ""
    where = ".".join(str(part) for part in first["loc"] if part not in UNWRITTEN)
    return said_plainly(first["type"], first["msg"]) + more, where


def said_plainly(kind: str, message: str) -> str:
    """Pydantic's message in the words of somebody who edits a TOML file."""
    plain = {"extra_forbidden": "unknown key", "missing": "is missing"}
    return plain.get(kind) or message.removeprefix("Value error, ")
