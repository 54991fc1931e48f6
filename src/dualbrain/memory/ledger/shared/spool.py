"""Items that wait for the server of a shared ledger: one file an item, synced to the disk, in the order of arrival."""

from __future__ import annotations

from pathlib import Path

import msgspec

from dualbrain.core.storage.atomic_files import fsync_folder, write_atomically
from dualbrain.core.storage.private_files import create_private_folder
from dualbrain.memory.ledger.hash_chain import Head

REFUSED_SUFFIX = ".refused"
"""Suffix of the files of refused items, which are kept for a person."""


class WaitingEvent(msgspec.Struct, frozen=True, kw_only=True):
    """An event without a vector that depends on no other event."""

    kind: str
    subject: str
    run: str
    payload: msgspec.Raw


class WaitingItem(msgspec.Struct, frozen=True, kw_only=True):
    """Work of the time `time` [s, 1970 UTC]: `events`, or without any an `episode` of `run` (see `memory.memory`).

    `attempts` are the first events of appends that were sent. The item is in the ledger if one of them is.
    """

    time: float
    run: str = ""
    events: tuple[WaitingEvent, ...] = ()
    episode: msgspec.Raw = msgspec.Raw(b"null")
    attempts: tuple[Head, ...] = ()


class Spool:
    """The items that wait in a folder; the folder exists only while there are some."""

    def __init__(self, folder: Path) -> None:
        """Use `folder`."""
        self.folder = folder

    def __len__(self) -> int:
        return len(self.files())

    def add(self, item: WaitingItem) -> None:
        """Append `item`; raises `FileWriteError` or `OSError` if the disk does not keep it."""
        create_private_folder(self.folder)
        write_atomically(self.folder / f"{self._next_number():08d}.json", msgspec.json.encode(item))

    def files(self) -> list[Path]:
        """The files of the items, oldest first."""
        return sorted(self.folder.glob("[0-9]*.json"))

    def read(self, file: Path) -> WaitingItem:
        """The item in `file`; raises one of `DECODE_ERRORS`."""
        return msgspec.json.decode(file.read_bytes(), type=WaitingItem)

    def replace(self, file: Path, item: WaitingItem) -> None:
        """Replace the item in `file`."""
        write_atomically(file, msgspec.json.encode(item))

    def remove(self, file: Path) -> None:
        """Remove the item in `file`, which is in the ledger now."""
        file.unlink(missing_ok=True)
        fsync_folder(self.folder)

    def put_away(self, file: Path) -> Path:
        """Keep an item that the ledger refuses, under the suffix `.refused`; returns its path.

        No item replaces an earlier one: if its number is taken, it gets the next free number.
        """
        refused = file.with_suffix(REFUSED_SUFFIX)
        if refused.exists():
            refused = self.folder / f"{self._next_number():08d}{REFUSED_SUFFIX}"
        file.rename(refused)
        fsync_folder(self.folder)
        return refused

    def _next_number(self) -> int:
        """The number after all numbers of waiting and refused items."""
        kept = (*self.files(), *self.folder.glob(f"[0-9]*{REFUSED_SUFFIX}"))
        return max((int(file.stem) for file in kept), default=0) + 1
