"""The state and the vectors in one file beside the ledger, so that a start need not read every event.

A snapshot is a projection, not truth: it is used only if a snapshot event in the chain names its SHA-256, the chain has
the event it was made at, and this program's embedding made its vectors. Else it is passed over and made again.
"""

from __future__ import annotations

import hashlib
import os
import struct
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import UNREADABLE
from dualbrain.memory.embedding.text_encoder import Rows
from dualbrain.memory.ledger.events import SNAPSHOT, SnapshotMark
from dualbrain.memory.ledger.hash_chain import Head
from dualbrain.memory.ledger.ledger import Entry, Ledger, LedgerReader
from dualbrain.memory.state.state import State

MAGIC = b"dbmemo02"
_LENGTHS = struct.Struct("<8sQ")


class Snapshot(msgspec.Struct):
    """The state at event `head`, and its vectors of shape (n, dim) with their block masks of shape (n,)."""

    head: Head
    versions: Mapping[str, str]
    state: State
    rows: Rows
    masks: NDArray[np.uint8]


class _Label(msgspec.Struct):
    """What stands before the arrays."""

    seq: int
    hash: str
    versions: dict[str, str]
    dim: int
    state: State


def write(ledger: Ledger, snapshot: Snapshot, *, now: float) -> Path:
    """Write the file, sync it, then the event that names it; older files are removed. Returns its path.

    A process killed on the way leaves the older snapshot in force.
    """
    path = _path(ledger, snapshot.head.seq)
    partial = path.with_suffix(".partial")
    head = snapshot.head
    label = _Label(head.seq, head.hash, dict(snapshot.versions), snapshot.rows.shape[1], snapshot.state)
    text = msgspec.msgpack.encode(label)
    digest = hashlib.sha256()
    with partial.open("wb") as file:
        for part in (
            _LENGTHS.pack(MAGIC, len(text)),
            text,
            snapshot.masks.data,
            np.ascontiguousarray(snapshot.rows).data,
        ):
            file.write(part)
            digest.update(part)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)
    ledger.append([Entry(SNAPSHOT, "", SnapshotMark(head.seq, digest.hexdigest()))], now=now)
    for old in path.parent.glob(f"{ledger.path.name}.snapshot-*"):
        if old != path:
            old.unlink(missing_ok=True)
    return path


def read(ledger: LedgerReader) -> Snapshot | None:
    """The newest snapshot that the chain vouches for; None if there is none, or it is damaged."""
    with suppress(OSError, *UNREADABLE, ValueError, struct.error):
        for event in reversed(list(ledger.events("kind = ?", (SNAPSHOT,)))[-1:]):
            mark = msgspec.json.decode(event.payload, type=SnapshotMark)
            return _read(_path(ledger, mark.as_of), mark, ledger)
    return None


def _read(path: Path, mark: SnapshotMark, ledger: LedgerReader) -> Snapshot | None:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        start = file.read(_LENGTHS.size)
        magic, length = _LENGTHS.unpack(start)
        if magic != MAGIC or length > path.stat().st_size:
            return None
        text = file.read(length)
        label = msgspec.msgpack.decode(text, type=_Label)
        n = len(label.state.memos)
        masks, rows = np.empty(n, np.uint8), np.empty((n, label.dim), np.float32)
        whole = file.readinto(masks.data) == masks.nbytes and file.readinto(rows.reshape(-1).data) == rows.nbytes
        for part in (start, text, masks.data, rows.reshape(-1).data):
            digest.update(part)
    if not whole or digest.hexdigest() != mark.sha256 or label.seq != mark.as_of:
        return None
    if ledger.event(label.seq).hash != label.hash:
        return None
    state = label.state
    state.rows = {memo.id: row for row, memo in enumerate(state.memos)}
    return Snapshot(Head(label.seq, label.hash), label.versions, state, rows, masks)


def _path(ledger: LedgerReader, seq: int) -> Path:
    return ledger.path.with_name(f"{ledger.path.name}.snapshot-{seq}")
