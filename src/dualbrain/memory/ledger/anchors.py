"""Anchors: copies of the newest event's number and hash outside the ledger, which reveal a shortened or rewritten one.

Every writer leaves an anchor beside the ledger (`<ledger>.anchor`), and every run one in its run folder
(`ledger_anchor.json`). A ledger, or an archive from which it was compacted, must still contain the event of each
anchor. A ledger that was copied back, lost its write-ahead log, or was replaced does not. A person who can change the
ledger and all anchors can still forge a history.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec

from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.errors import DECODE_ERRORS, DualbrainError
from dualbrain.memory.ledger.events import ACCEPTED, COMPACTED, AcceptedLoss, CompactionRecord
from dualbrain.memory.ledger.hash_chain import CorruptLedgerError, Head, LedgerEvent

if TYPE_CHECKING:
    from dualbrain.memory.ledger.reader import LedgerReader

RUN_ANCHOR_FILE = "ledger_anchor.json"
"""File of a run folder with the anchor of the ledger that the run used."""
MAX_RUN_ANCHORS = 200
"""Number of run folders, the newest first, whose anchors are read in each folder of runs."""
MAX_FOLDERS_OF_RUNS = 20
"""Number of folders of runs, the newest last, that the anchor beside the ledger names."""
MAX_ANCHOR_BYTES = 1 << 16
MAX_ARCHIVES = 100
"""Longest chain of archives that is followed."""


class LedgerAnchor(msgspec.Struct, frozen=True, kw_only=True):
    """Number and hash of the newest event at `time` [s, 1970 UTC], and the absolute path of the ledger.

    In the anchor beside the ledger, `run_folders` are the folders that contain run folders with more anchors.
    """

    seq: Annotated[int, msgspec.Meta(ge=0, lt=1 << 62)]
    hash: str
    time: float
    ledger: str
    run_folders: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class AnchorFault:
    """An anchor in the file `source` whose event the ledger does not contain; `sentence` describes the fault."""

    anchor: LedgerAnchor
    source: Path
    sentence: str


@dataclass(frozen=True, slots=True, kw_only=True)
class AnchorReport:
    """Result of the comparison with all anchors: number of anchors, faults, and notices that are not faults.

    `run_folders` are the folders of runs that the anchor beside the ledger names.
    """

    compared: int
    run_folders: tuple[str, ...]
    faults: tuple[AnchorFault, ...]
    notices: tuple[str, ...]


class AnchorMismatchError(CorruptLedgerError):
    """The ledger does not contain events that it had contained: it was shortened, rewritten or replaced."""

    def __init__(self, faults: tuple[AnchorFault, ...], path: Path) -> None:
        """Report the fault with the newest anchor."""
        self.faults = faults
        worst = max(faults, key=lambda fault: fault.anchor.seq)
        self.fault, self.seq, self.path = worst.sentence, worst.anchor.seq, str(path)
        DualbrainError.__init__(
            self,
            f"{worst.sentence} Nothing was changed, and nothing is appended to it. Restore the newest copy of the "
            f"ledger with its -wal file. If the loss is intended, accept it with "
            f"`dualbrain memory verify --ledger {path} --accept REASON`. {worst.source}",
        )


def anchor_path(ledger: Path) -> Path:
    """The anchor file beside `ledger`."""
    return ledger.with_name(f"{ledger.name}.anchor")


def write_anchor(path: Path, ledger: LedgerReader, *, now: float, run_folders: Sequence[str] = ()) -> Head:
    """Write the anchor of the newest event to `path` (mode 0600) and return it; raises `FileWriteError`."""
    head = ledger.head()
    anchor = LedgerAnchor(
        seq=head.seq,
        hash=head.hash,
        time=now,
        ledger=str(ledger.path.resolve()),
        run_folders=tuple(run_folders[-MAX_FOLDERS_OF_RUNS:]),
    )
    write_atomically(path, msgspec.json.encode(anchor) + b"\n")
    return head


def read_anchor(path: Path) -> LedgerAnchor | None:
    """The anchor in the file `path`, None if there is none; raises `OSError` or one of `DECODE_ERRORS`."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except (FileNotFoundError, NotADirectoryError):
        return None
    with os.fdopen(descriptor, "rb") as file:
        return msgspec.json.decode(file.read(MAX_ANCHOR_BYTES), type=LedgerAnchor)


def check_anchors(ledger: LedgerReader, run_folders: Iterable[Path] = ()) -> AnchorReport:
    """Compare `ledger` with the anchor beside it and with those in run folders.

    Run folders are those in `run_folders`, and in the folders that the anchor beside the ledger names. The cost is
    bounded: one small file for each of the newest `MAX_RUN_ANCHORS` run folders of a folder, one lookup per anchor.
    """
    faults, notices, named, compared = list[AnchorFault](), list[str](), list[str](), 0
    accepted = _accepted(ledger)
    beside = anchor_path(ledger.path)
    for source, anchor in _anchors(ledger, beside, run_folders, faults, notices):
        compared += 1
        named += anchor.run_folders if source == beside else ()
        if (anchor.seq, anchor.hash) in accepted or _contains(ledger, anchor, notices):
            continue
        faults.append(AnchorFault(anchor, source, _sentence(ledger, anchor)))
    if compared and not beside.exists():
        words = f"it was compared with {compared} of its anchors in run folders"
        notices.append(f"The anchor file of the memory ledger is missing: {words}. It was removed: {beside}")
    return AnchorReport(compared=compared, run_folders=tuple(named), faults=tuple(faults), notices=tuple(notices))


def accepted_loss(report: AnchorReport, reason: str, actor: str) -> AcceptedLoss:
    """The payload of the event that accepts every fault of `report`."""
    lost = tuple((fault.anchor.seq, fault.anchor.hash) for fault in report.faults)
    return AcceptedLoss(anchors=lost, reason=reason, actor=actor)


def descends_from(ledger: LedgerReader, head: Head) -> bool:
    """Whether `ledger`, or an archive beside it from which it was compacted, contains the event `head`.

    A ledger that contains this event also contains all events before it, because events are chained.
    """
    if _has_event(ledger, head):
        return True
    return any(_has_event(archive, head) for archive in _archives(ledger))


def compaction_source(event: LedgerEvent) -> CompactionRecord | None:
    """The ledger from which this one was compacted, as its first `event` states; None if it was not compacted."""
    return msgspec.json.decode(event.payload, type=CompactionRecord) if event.kind == COMPACTED else None


def _anchors(
    ledger: LedgerReader, beside: Path, run_folders: Iterable[Path], faults: list[AnchorFault], notices: list[str]
) -> Iterator[tuple[Path, LedgerAnchor]]:
    """The file and the anchor of this ledger; an unreadable anchor is a fault beside the ledger, else a notice."""
    folders = {folder.resolve() for folder in run_folders}
    try:
        if anchor := read_anchor(beside):
            folders |= {Path(folder) for folder in anchor.run_folders[-MAX_FOLDERS_OF_RUNS:] if "\0" not in folder}
            yield beside, anchor
    except (OSError, *DECODE_ERRORS) as error:
        unknown = LedgerAnchor(seq=0, hash="", time=0.0, ledger=str(ledger.path))
        faults.append(AnchorFault(unknown, beside, f"The anchor of the memory ledger cannot be read: {error}."))
    path = str(ledger.path.resolve())
    for file in _run_anchor_files(folders):
        try:
            anchor = read_anchor(file)
        except (OSError, *DECODE_ERRORS) as error:
            notices.append(f"The anchor of a run folder cannot be read ({error}): {file}")
            continue
        if anchor is not None and anchor.ledger == path:
            yield file, anchor


def _run_anchor_files(folders: Iterable[Path]) -> Iterator[Path]:
    """The anchors of the newest run folders in each of `folders`."""
    for parent in sorted(folders):
        try:
            with os.scandir(parent) as entries:
                found = [(entry.stat().st_mtime, entry.path) for entry in entries if entry.is_dir()]
        except OSError:
            continue  # removed, or not readable: its anchors are not there
        for _, folder in sorted(found, reverse=True)[:MAX_RUN_ANCHORS]:
            yield Path(folder) / RUN_ANCHOR_FILE


def _accepted(ledger: LedgerReader) -> frozenset[tuple[int, str]]:
    """The anchors whose loss a person accepted."""
    try:
        found = [msgspec.json.decode(event.payload, type=AcceptedLoss).anchors for event in ledger.events(ACCEPTED)]
    except DECODE_ERRORS:
        return frozenset()
    return frozenset(anchor for anchors in found for anchor in anchors)


def _contains(ledger: LedgerReader, anchor: LedgerAnchor, notices: list[str]) -> bool:
    head = Head(anchor.seq, anchor.hash)
    if anchor.seq == 0 or descends_from(ledger, head):
        return True
    for opened in chain([ledger], _archives(ledger)):
        first, source = _first_event(opened)
        if first is None or source is None or anchor.seq > source.seq or anchor.time > first.time:
            continue
        if (anchor.seq, anchor.hash) == (source.seq, source.hash):
            return True
        if not (archive := _archive_path(opened, source)).is_file():
            notices.append(
                f"Event {anchor.seq} cannot be compared: the archive of the compaction is missing: {archive}"
            )
            return True
    return False


def _first_event(ledger: LedgerReader) -> tuple[LedgerEvent | None, CompactionRecord | None]:
    """The first event, and the ledger from which this one was compacted."""
    first = next(ledger.events(until=1), None)
    try:
        return first, compaction_source(first) if first else None
    except DECODE_ERRORS:
        return first, None


def _has_event(ledger: LedgerReader, head: Head) -> bool:
    return any(event.hash == head.hash for event in ledger.events(after=head.seq - 1, until=head.seq))


def _archives(ledger: LedgerReader) -> Iterator[LedgerReader]:
    """The ledgers from which `ledger` was compacted, newest first, each open until the next one is requested."""
    opened, number = ledger, 0
    try:
        while number < MAX_ARCHIVES:
            _, source = _first_event(opened)
            if source is None or not (archive := _archive_path(opened, source)).is_file():
                return
            following = ledger.open_archive(archive)
            if opened is not ledger:
                opened.close()
            opened, number = following, number + 1
            yield opened
    finally:
        if opened is not ledger:
            opened.close()


def _archive_path(ledger: LedgerReader, source: CompactionRecord) -> Path:
    return ledger.path.parent / f"{Path(source.archive).name}.archive-{source.seq}"


def _sentence(ledger: LedgerReader, anchor: LedgerAnchor) -> str:
    head = ledger.head()
    try:
        date = datetime.fromtimestamp(anchor.time, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    except (ValueError, OverflowError, OSError):
        date = "an unknown time"
    had = f"The memory ledger {ledger.path} contained event {anchor.seq} at {date}"
    if head.seq < anchor.seq:
        return f"{had}, but now it ends at event {head.seq}: its newest events are missing, or it was replaced."
    return f"{had}, but now its event {anchor.seq} is another one: it was rewritten or replaced."
