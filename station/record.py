"""The append-only record: what was asked, decided, published and acknowledged.

A request runs through entries ACCEPTED, DECIDED, PUBLISHED, ACKED, FILED that share its record number;
UNDELIVERED closes a decision that must not be shown any more. An entry is committed with fsync, read back
and, if it is a decision, proven again from the stored numbers before a `CommittedVerdict` exists; only
that can be published.
"""

import fcntl
import json
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Self, TextIO

from station.chain import (
    FILE,
    STATION_PHASES,
    Entry,
    Phase,
    RecordBroken,
    RecordFailed,
    canonical,
    chain,
    check_anchor,
    connect,
    create,
    genesis,
    read,
    row_of,
    write_anchor,
)
from station.journal import digests, file_sha256, job_folder
from station.proof import Decision, unproven

_DECIDED: tuple[Phase, ...] = ("DECIDED", "PUBLISHED", "ACKED", "UNDELIVERED")
_AFTER: dict[Phase, tuple[Phase, ...]] = {
    "DECIDED": ("ACCEPTED",),
    "PUBLISHED": ("DECIDED", "PUBLISHED"),
    "ACKED": ("DECIDED", "PUBLISHED"),
    "UNDELIVERED": ("DECIDED",),
    "FILED": _DECIDED,
}


class AnotherStation(RecordFailed):
    """A running station holds this record."""


class DuplicateRequest(Exception):
    """This sequence has its record already."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Ticket:
    """One request of the PLC, as accepted. The sequence is its key."""

    sequence: int
    serial: str
    recipe: int
    fixture: int
    plc_epoch: int
    part_number: str
    simulated: bool
    at_utc: str


@dataclass(frozen=True, slots=True, kw_only=True)
class CommittedVerdict:
    """A decision as read back from the record and proven again; made here and nowhere else."""

    record_no: int
    ticket: Ticket
    decision: Decision


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """How far a request has come: its ticket, its latest phase and what was decided."""

    record_no: int
    ticket: Ticket
    phase: Phase = "ACCEPTED"
    decision: Decision | None = None
    ack_code: int | None = None
    published_utc: str | None = None
    acked_utc: str | None = None

    @property
    def stands(self) -> bool:
        """Whether its verdict is, or still has to be, in the registers."""
        decided = self.decision is not None and not self.decision.interrupted
        return decided and self.phase in ("DECIDED", "PUBLISHED")

    @property
    def verdict(self) -> str | None:
        """The word that may be shown: a decision that was never delivered releases nothing."""
        if self.decision is None:
            return None
        return "HOLD" if self.phase == "UNDELIVERED" else self.decision.verdict

    @property
    def released(self) -> bool:
        """Whether the part may leave as sound: a PASS that the PLC has taken and carried out."""
        return self.verdict == "PASS" and self.phase == "ACKED" and self.ack_code == 1


class Record:
    """The open record of the one running station. Not for two threads at once."""

    def __init__(self, directory: Path, lock: TextIO, db: sqlite3.Connection) -> None:
        self.directory = directory
        self._lock = lock
        self._db = db
        self._head = genesis()
        self._requests: dict[int, Request] = {}
        self._by_record: dict[int, int] = {}
        self._failed = False
        self.epoch = 0

    @classmethod
    def open(cls, directory: Path, *, station: Mapping[str, str], at_utc: str) -> Self:
        """The record in `directory`, created if there was none, its chain checked, this start entered.

        Raises `AnotherStation`, `RecordBroken` or `RecordFailed`, and then holds nothing."""
        try:
            directory.mkdir(parents=True, exist_ok=True)
            lock = _lock(directory)
        except OSError as error:
            raise RecordFailed(f"{directory}: {error.strerror}") from error
        try:
            create(directory)
            record = cls(directory, lock, connect(directory))
            record._load()
            record._enter(0, record.epoch, "STARTED", {**station, "at_utc": at_utc})
        except (OSError, sqlite3.Error) as error:
            lock.close()
            raise RecordFailed(f"{directory / FILE}: {error}") from error
        except RecordFailed:
            lock.close()
            raise
        return record

    def close(self) -> None:
        """Releases the record for another station."""
        self._db.close()
        self._lock.close()

    def reopen(self) -> None:
        """Returns when the store works again after it failed: chain and head read anew, an entry taken."""
        if not self._failed:
            return
        self._db.close()
        try:
            self._db = connect(self.directory)
            self._load()
        except sqlite3.Error as error:
            raise RecordFailed(f"{self.directory / FILE}: {error}") from error
        self._failed = False
        self._enter(0, self.epoch, "OPERATOR", {"what": "reopened"})

    def distrust(self) -> None:
        """Has nothing more written until `reopen`: somebody could not wait for the end of a write."""
        self._failed = True

    @property
    def failed(self) -> bool:
        """Whether the store failed, so that nothing is written until `reopen`."""
        return self._failed

    def past(self, sequence: int) -> Request | None:
        """What became of an earlier request with this sequence."""
        return self._requests.get(sequence)

    def requests(self) -> tuple[Request, ...]:
        """Every request, oldest first."""
        return tuple(self._requests.values())

    def request(self, record_no: int) -> Request:
        """One request by its record number."""
        return self._requests[self._sequence(record_no)]

    def accept(self, ticket: Ticket) -> int:
        """The new record number of a request; `DuplicateRequest` if its sequence was used before."""
        if ticket.sequence in self._requests:
            raise DuplicateRequest(f"request {ticket.sequence} is in the record already")
        record_no = len(self._requests) + 1
        self._enter(record_no, ticket.sequence, "ACCEPTED", asdict(ticket))
        return record_no

    def decide(self, record_no: int, decision: Decision) -> CommittedVerdict:
        """The verdict as committed, read back and proven again from the stored numbers."""
        refusal = unproven(decision)
        if refusal is not None:
            raise RecordFailed(f"record {record_no}: {decision.verdict} is not proven: {refusal}")
        entry = self._enter(record_no, self._sequence(record_no), "DECIDED", asdict(decision))
        stored = Decision.from_body(json.loads(entry.body))
        if stored != decision or unproven(stored) is not None:
            self._failed = True
            raise RecordFailed(f"record {record_no}: the stored decision is not the one that was taken")
        return self.committed(record_no)

    def committed(self, record_no: int) -> CommittedVerdict:
        """The verdict of a record that was decided, for showing it again."""
        request = self.request(record_no)
        if request.decision is None:
            raise RecordFailed(f"record {record_no} has no decision")
        return CommittedVerdict(record_no=record_no, ticket=request.ticket, decision=request.decision)

    def published(self, record_no: int, at_utc: str) -> None:
        """Enters that the verdict stands in the registers."""
        self._enter(record_no, self._sequence(record_no), "PUBLISHED", {"at_utc": at_utc})

    def acked(self, record_no: int, code: int, at_utc: str) -> None:
        """Enters what the PLC says it did with the part."""
        self._enter(record_no, self._sequence(record_no), "ACKED", {"code": code, "at_utc": at_utc})

    def undelivered(self, record_no: int, reason: str, at_utc: str) -> None:
        """Enters that the verdict must not be shown any more."""
        self._enter(record_no, self._sequence(record_no), "UNDELIVERED", {"reason": reason, "at_utc": at_utc})

    def filed(self, record_no: int, at_utc: str) -> None:
        """Enters the digests of all files that now lie in the job folder."""
        files = digests(job_folder(self.directory, record_no))
        self._enter(record_no, self._sequence(record_no), "FILED", {"files": files, "at_utc": at_utc})

    def operator(self, what: str, at_utc: str) -> None:
        """Enters what a person asked for."""
        self._enter(0, self.epoch, "OPERATOR", {"what": what, "at_utc": at_utc})

    def _sequence(self, record_no: int) -> int:
        return self._by_record[record_no]

    def _load(self) -> None:
        """Reads everything anew. Until that is done the requests known before stand: the PLC asks on."""
        head, starts = genesis(), 0
        requests: dict[int, Request] = {}
        for entry in chain(self._db):
            head = entry
            starts += entry.phase == "STARTED"
            if entry.phase not in STATION_PHASES:
                requests[entry.sequence] = fold(requests.get(entry.sequence), entry)
        check_anchor(self.directory, self._db)
        self._head, self._requests = head, requests
        self._by_record = {request.record_no: sequence for sequence, request in requests.items()}
        self.epoch = self.epoch or starts % 0xFFFF + 1

    def _fold(self, entry: Entry) -> None:
        self._head = entry
        if entry.phase in STATION_PHASES:
            return
        self._requests[entry.sequence] = fold(self._requests.get(entry.sequence), entry)
        self._by_record[entry.record_no] = entry.sequence

    def _enter(self, record_no: int, sequence: int, phase: Phase, body: Mapping[str, Any]) -> Entry:
        """The entry as it was read back after its commit."""
        if self._failed:
            raise RecordFailed("the result store failed before; nothing is written until it is opened again")
        entry = Entry(
            entry_no=self._head.entry_no + 1,
            record_no=record_no,
            sequence=sequence,
            phase=phase,
            body=canonical(body),
            previous=self._head.hash,
            hash="",
        )
        entry = replace(entry, hash=entry.digest())
        if phase not in STATION_PHASES:
            fold(self._requests.get(sequence), entry)  # refuses here what must not follow
        try:
            with self._db:
                self._db.execute("BEGIN IMMEDIATE")
                self._db.execute("INSERT INTO entry VALUES (?, ?, ?, ?, ?, ?, ?)", row_of(entry))
            stored = read(self._db, entry.entry_no)
            write_anchor(self.directory, entry)
        except (OSError, sqlite3.Error) as error:
            # A second fsync may report success for pages that the first one lost: never try again.
            self._failed = True
            raise RecordFailed(f"{self.directory / FILE}: {error}") from error
        if stored != entry:
            self._failed = True
            raise RecordFailed(f"entry {entry.entry_no} was read back differently")
        self._fold(stored)
        return stored


def fold(request: Request | None, entry: Entry) -> Request:
    """The request after `entry`; `RecordBroken` when that entry cannot follow or cannot be read."""
    try:
        return _folded(request, entry, json.loads(entry.body))
    except (TypeError, KeyError, ValueError) as error:
        raise RecordBroken(f"entry {entry.entry_no}: {entry.phase} cannot be read: {error}") from error


def _folded(request: Request | None, entry: Entry, body: dict[str, Any]) -> Request:
    if entry.phase == "ACCEPTED" and request is None:
        return Request(record_no=entry.record_no, ticket=Ticket(**body))
    if request is None or request.record_no != entry.record_no or entry.phase == "ACCEPTED":
        raise RecordBroken(f"entry {entry.entry_no}: {entry.phase} does not follow")
    if request.phase not in _AFTER.get(entry.phase, ()):
        raise RecordBroken(f"entry {entry.entry_no}: {entry.phase} does not follow {request.phase}")
    match entry.phase:
        case "DECIDED":
            return replace(request, phase="DECIDED", decision=Decision.from_body(body))
        case "PUBLISHED":
            return replace(request, phase="PUBLISHED", published_utc=body["at_utc"])
        case "ACKED":
            return replace(request, phase="ACKED", ack_code=body["code"], acked_utc=body["at_utc"])
        case "UNDELIVERED":
            return replace(request, phase="UNDELIVERED")
    return request


def read_requests(directory: Path) -> tuple[Request, ...]:
    """Every request of a record, oldest first; for those who only read."""
    requests: dict[int, Request] = {}
    with closing(connect(directory)) as db:
        for entry in chain(db):
            if entry.phase not in STATION_PHASES:
                requests[entry.sequence] = fold(requests.get(entry.sequence), entry)
    return tuple(requests.values())


def _lock(directory: Path) -> TextIO:
    # The kernel releases this lock with the process, however it dies; children do not inherit it.
    lock = (directory / "station.lock").open("a")
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        lock.close()
        raise AnotherStation(f"{directory}: another station program is running") from None
    return lock


def verify(directory: Path) -> tuple[str, ...]:
    """Everything in which the record does not prove itself; empty when it does."""
    if not (directory / FILE).exists():
        return (f"{directory / FILE}: no such record",)
    try:
        with closing(connect(directory)) as db:
            if (state := db.execute("PRAGMA quick_check").fetchone()[0]) != "ok":
                return (f"{directory / FILE}: {state}",)
            requests, files = _prove(db)
            check_anchor(directory, db)
    except RecordBroken as error:
        return (str(error),)
    except (sqlite3.Error, OSError, ValueError, KeyError, TypeError) as error:
        return (f"{directory / FILE}: {error}",)
    return (*_misfiled(directory, files), *_orphans(directory, len(requests)))


def _prove(db: sqlite3.Connection) -> tuple[dict[int, Request], dict[int, dict[str, str]]]:
    requests: dict[int, Request] = {}
    files: dict[int, dict[str, str]] = {}
    for entry in chain(db):
        if entry.phase in STATION_PHASES:
            continue
        request = requests[entry.sequence] = fold(requests.get(entry.sequence), entry)
        if request.record_no > len(requests):
            raise RecordBroken(f"entry {entry.entry_no}: record number {request.record_no} is out of order")
        if entry.phase == "DECIDED" and request.decision and (why := unproven(request.decision)):
            raise RecordBroken(f"record {entry.record_no}: {request.decision.verdict} is not proven: {why}")
        if entry.phase in ("DECIDED", "FILED"):
            files.setdefault(entry.record_no, {}).update(json.loads(entry.body)["files"])
    return requests, files


def _misfiled(directory: Path, files: Mapping[int, Mapping[str, str]]) -> Iterator[str]:
    for record_no, expected in files.items():
        folder = job_folder(directory, record_no)
        for name, sha256 in expected.items():
            path = folder / name
            if not path.is_file():
                yield f"{path}: missing"
            elif file_sha256(path) != sha256:
                yield f"{path}: not the file that was recorded"


def _orphans(directory: Path, count: int) -> Iterator[str]:
    for folder in sorted((directory / "jobs").glob("[0-9]*")):
        if not (folder.name.isdigit() and 1 <= int(folder.name) <= count):
            yield f"{folder}: no record of this job"
