"""Snapshots: state and vectors in one file beside the ledger, so that a start need not read every event.

A snapshot is a projection of the ledger. It is used only if a snapshot event in the chain names its SHA-256, the chain
contains the event of which it has the state, and its vectors were computed by the present embedding. Otherwise it is
ignored and written again.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.encoder import Float32Array
from dualbrain.core.storage.private_files import private_file
from dualbrain.errors import DECODE_ERRORS
from dualbrain.memory.ledger.events import SNAPSHOT, SnapshotRecord
from dualbrain.memory.ledger.hash_chain import Head
from dualbrain.memory.ledger.ledger import Ledger, LedgerReader, PendingEvent
from dualbrain.memory.state.state import LedgerState

MAGIC = b"dbmemo02"
_PREAMBLE = struct.Struct("<8sQ")


class MemorySnapshot(msgspec.Struct, kw_only=True):
    """The state at event `head`, and its vectors of shape (n, dim) with their block masks of shape (n,)."""

    head: Head
    versions: Mapping[str, str]
    state: LedgerState
    rows: Float32Array
    masks: NDArray[np.uint8]


class _SnapshotHeader(msgspec.Struct, kw_only=True):
    """The header before the arrays."""

    seq: int
    hash: str
    versions: dict[str, str]
    dim: int
    state: LedgerState


def write_snapshot(ledger: Ledger, snapshot: MemorySnapshot, *, now: float) -> Path:
    """Write and sync the file, then append the event that names it and remove older files; returns the path.

    If the process is killed before the event is appended, the previous snapshot stays in use.
    """
    path = _path(ledger, snapshot.head.seq)
    head = snapshot.head
    header = _SnapshotHeader(
        seq=head.seq, hash=head.hash, versions=dict(snapshot.versions), dim=snapshot.rows.shape[1], state=snapshot.state
    )
    text = msgspec.msgpack.encode(header)
    digest = hashlib.sha256()
    with private_file(path) as temporary, temporary.open("wb") as file:
        for part in (
            _PREAMBLE.pack(MAGIC, len(text)),
            text,
            snapshot.masks.data,
            np.ascontiguousarray(snapshot.rows).data,
        ):
            file.write(part)
            digest.update(part)
    ledger.append(
        [PendingEvent(kind=SNAPSHOT, subject="", payload=SnapshotRecord(head.seq, digest.hexdigest()))], now=now
    )
    for old in path.parent.glob(f"{ledger.path.name}.snapshot-*"):
        if old != path:
            old.unlink(missing_ok=True)
    return path


def read_snapshot(ledger: LedgerReader) -> MemorySnapshot | None:
    """The snapshot of the newest snapshot event whose file is on this machine; None if none is, or it is damaged.

    Each robot of a shared ledger has files of its own.
    """
    with suppress(OSError, *DECODE_ERRORS, ValueError, struct.error):
        for event in reversed(list(ledger.events(SNAPSHOT))):
            record = msgspec.json.decode(event.payload, type=SnapshotRecord)
            if (path := _path(ledger, record.as_of)).exists():
                return _read_file(path, record, ledger)
    return None


def _read_file(path: Path, record: SnapshotRecord, ledger: LedgerReader) -> MemorySnapshot | None:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        start = file.read(_PREAMBLE.size)
        magic, length = _PREAMBLE.unpack(start)
        if magic != MAGIC or length > path.stat().st_size:
            return None
        text = file.read(length)
        header = msgspec.msgpack.decode(text, type=_SnapshotHeader)
        n = len(header.state.memories)
        masks, rows = np.empty(n, np.uint8), np.empty((n, header.dim), np.float32)
        complete = file.readinto(masks.data) == masks.nbytes and file.readinto(rows.reshape(-1).data) == rows.nbytes
        for part in (start, text, masks.data, rows.reshape(-1).data):
            digest.update(part)
    if not complete or digest.hexdigest() != record.sha256 or header.seq != record.as_of:
        return None
    if ledger.event(header.seq).hash != header.hash:
        return None
    state = header.state
    state.rows = {memo.id: row for row, memo in enumerate(state.memories)}
    return MemorySnapshot(
        head=Head(header.seq, header.hash), versions=header.versions, state=state, rows=rows, masks=masks
    )


def _path(ledger: LedgerReader, seq: int) -> Path:
    return ledger.path.with_name(f"{ledger.path.name}.snapshot-{seq}")
