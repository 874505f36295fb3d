"""The SQLite file of the record: its schema, its chain of SHA-256 and the anchor beside it.

Nothing is updated or deleted: triggers refuse it, the chain would show it, and the anchor would show a
tail that was cut off. Rollback journal and `synchronous = EXTRA`: SQLite before 3.51.3 can corrupt a WAL
under concurrent checkpoints, and WAL with NORMAL loses commits at a power cut.
"""

import hashlib
import json
import sqlite3
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from station.journal import sync_folder, write_durably

FILE = "record.sqlite"
ANCHOR = "anchor.json"
APPLICATION_ID = 0x42434C4C
GENESIS = "0" * 64
BUSY_S = 5.0

_PAGE = "SELECT * FROM entry WHERE entry_no > ? ORDER BY entry_no LIMIT 500"

Phase = Literal["STARTED", "ACCEPTED", "DECIDED", "PUBLISHED", "ACKED", "UNDELIVERED", "FILED", "OPERATOR"]
STATION_PHASES = ("STARTED", "OPERATOR")

SCHEMA = {
    "entry": """CREATE TABLE entry (
        entry_no INTEGER PRIMARY KEY,
        record_no INTEGER NOT NULL,
        sequence INTEGER NOT NULL,
        phase TEXT NOT NULL CHECK (phase IN ('STARTED', 'ACCEPTED', 'DECIDED', 'PUBLISHED', 'ACKED',
                                             'UNDELIVERED', 'FILED', 'OPERATOR')),
        body TEXT NOT NULL,
        previous TEXT NOT NULL,
        hash TEXT NOT NULL UNIQUE
    ) STRICT""",
    "one_request": "CREATE UNIQUE INDEX one_request ON entry (sequence) WHERE phase = 'ACCEPTED'",
    "one_of_each": """CREATE UNIQUE INDEX one_of_each ON entry (record_no, phase)
        WHERE phase IN ('ACCEPTED', 'DECIDED', 'ACKED', 'UNDELIVERED', 'FILED')""",
    "no_update": """CREATE TRIGGER no_update BEFORE UPDATE ON entry
        BEGIN SELECT RAISE(ABORT, 'the record is append-only'); END""",
    "no_delete": """CREATE TRIGGER no_delete BEFORE DELETE ON entry
        BEGIN SELECT RAISE(ABORT, 'the record is append-only'); END""",
}


class RecordFailed(Exception):
    """The store did not take or give back an entry; no verdict can be given until it is opened again."""


class RecordBroken(RecordFailed):
    """The chain, the schema or the anchor does not hold."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One link of the chain."""

    entry_no: int
    record_no: int
    sequence: int
    phase: Phase
    body: str
    previous: str
    hash: str

    def digest(self) -> str:
        """The hash that this entry must have."""
        return _sha256(
            canonical([self.entry_no, self.record_no, self.sequence, self.phase, self.body, self.previous])
        )


def chain(db: sqlite3.Connection) -> Iterator[Entry]:
    """Every entry in order, each proven against the one before; raises `RecordBroken`."""
    previous = genesis()
    for entry in _entries(db):
        linked = entry.entry_no == previous.entry_no + 1 and entry.previous == previous.hash
        if not (linked and entry.hash == entry.digest()):
            raise RecordBroken(f"the chain breaks at entry {previous.entry_no + 1}")
        yield entry
        previous = entry


def _entries(db: sqlite3.Connection) -> Iterator[Entry]:
    # Page by page: a long read would hold its lock against the station that wants to commit.
    last = -(2**63)
    while rows := db.execute(_PAGE, (last,)).fetchall():
        for row in rows:
            yield Entry(**dict(zip(Entry.__slots__, row, strict=True)))
        last = rows[-1][0]


def connect(directory: Path) -> sqlite3.Connection:
    """The existing record, its schema checked; raises `RecordBroken` for a foreign or changed file."""
    db = sqlite3.connect(
        f"file:{directory / FILE}?mode=rw",
        uri=True,
        timeout=BUSY_S,
        isolation_level=None,
        check_same_thread=False,
    )
    try:
        db.execute("PRAGMA journal_mode = DELETE")
        db.execute("PRAGMA synchronous = EXTRA")
        _check_schema(db)
    except sqlite3.DatabaseError as error:
        db.close()
        if isinstance(error, sqlite3.OperationalError):
            raise
        raise RecordBroken(f"{directory / FILE}: {error}") from error
    except RecordBroken:
        db.close()
        raise
    return db


def canonical(value: object) -> str:
    """The one JSON text of a value."""
    return json.dumps(value, sort_keys=True, allow_nan=False, separators=(",", ":"))


def exists(directory: Path) -> bool:
    """Whether there is, or must once have been, a record."""
    return any((directory / name).exists() for name in (FILE, ANCHOR))


def genesis() -> Entry:
    """What the first entry follows."""
    return Entry(
        entry_no=0, record_no=0, sequence=0, phase="STARTED", body="", previous=GENESIS, hash=GENESIS
    )


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def row_of(entry: Entry) -> tuple[object, ...]:
    """The columns of an entry."""
    return tuple(getattr(entry, name) for name in Entry.__slots__)


def read(db: sqlite3.Connection, entry_no: int) -> Entry | None:
    """One entry as it is stored."""
    row = db.execute("SELECT * FROM entry WHERE entry_no = ?", (entry_no,)).fetchone()
    return Entry(**dict(zip(Entry.__slots__, row, strict=True))) if row else None


def create(directory: Path) -> None:
    """Returns when there is a record: the one that was there, or an empty one, whole under its name."""
    if exists(directory):
        return
    beside = directory / f"{FILE}.part"
    with suppress(FileNotFoundError):
        beside.unlink()
    with closing(sqlite3.connect(beside, isolation_level=None)) as db:
        db.execute("PRAGMA synchronous = EXTRA")
        db.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        for statement in SCHEMA.values():
            db.execute(statement)
    beside.chmod(0o640)
    beside.rename(directory / FILE)
    sync_folder(directory)


def _check_schema(db: sqlite3.Connection) -> None:
    names = dict(db.execute("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL"))
    known = db.execute("PRAGMA application_id").fetchone()[0] == APPLICATION_ID
    if not known or names != SCHEMA:
        raise RecordBroken("not a record of this program, or its schema was changed")


def write_anchor(directory: Path, head: Entry) -> None:
    """Returns when the anchor beside the record names `head` as its last entry."""
    anchor = {"entry_no": head.entry_no, "hash": head.hash}
    write_durably(directory / ANCHOR, canonical(anchor).encode())


def check_anchor(directory: Path, db: sqlite3.Connection) -> None:
    """Raises `RecordBroken` unless the entry that the anchor names is in the record.

    After a kill between commit and anchor the anchor is one entry behind, or absent after the first."""
    try:
        anchor = json.loads((directory / ANCHOR).read_bytes())
    except FileNotFoundError:
        anchor = None
    except (ValueError, RecursionError):
        raise RecordBroken(f"{directory / ANCHOR} is not readable") from None
    if anchor is None:
        if read(db, 2) is not None:
            raise RecordBroken(f"{directory / ANCHOR} is missing")
        return
    match anchor:
        case {"entry_no": int(entry_no), "hash": str(digest)}:
            entry = read(db, entry_no)
        case _:
            raise RecordBroken(f"{directory / ANCHOR} names no entry")
    if entry is None or entry.hash != digest:
        raise RecordBroken(f"the record ends before entry {entry_no}, which its anchor names")
