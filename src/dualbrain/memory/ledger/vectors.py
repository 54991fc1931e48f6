"""Vectors of episodes and their digests: each digest is in an event, so that the hash chain covers the vector too.

The event of an episode contains the digest of its vector. When vectors are recomputed, a `vectors` event contains the
digests that differ from the recorded ones. Episodes of ledgers from before this rule have no digest.
"""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import msgspec

from dualbrain.memory.ledger.events import EPISODE, VECTORS, VectorDigests
from dualbrain.memory.ledger.hash_chain import LedgerEvent

DIGEST_FIELD = "vector_sha256"
"""Field of the payload of an episode event: digest of its vector."""
MAX_DIGESTS_PER_EVENT = 1000
_FRAME = struct.Struct("<qqq")


@dataclass(frozen=True, slots=True)
class StoredVector:
    """One row of the vector projection: `version` of its embedding and `data` as little-endian float32.

    Bit b of `mask` is set if block b is present (see `joint_embedding.BLOCKS`).
    """

    version: str
    data: bytes
    mask: int = 0


class VectorReport(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a check of all vectors: those checked, those without a recorded digest, and a fault by event number."""

    checked: int = 0
    without_digest: int = 0
    faults: Mapping[int, str] = {}


class _EpisodeDigest(msgspec.Struct, frozen=True):
    vector_sha256: str = ""


def vector_digest(vector: StoredVector) -> str:
    """SHA-256 over version, mask and data of `vector`, each preceded by its length."""
    version = vector.version.encode("utf-8", "surrogateescape")
    frame = _FRAME.pack(len(version), vector.mask, len(vector.data))
    return hashlib.sha256(frame + version + vector.data).hexdigest()


def recorded_digests(events: Iterable[LedgerEvent]) -> dict[int, str]:
    """The newest recorded digest of each vector by the number of its episode event; "" if it was removed.

    `events` are the episode and `vectors` events in their order. Raises one of `DECODE_ERRORS` for an invalid payload.
    """
    digests: dict[int, str] = {}
    for event in events:
        if event.kind == VECTORS:
            digests.update(msgspec.json.decode(event.payload, type=VectorDigests).digests)
        elif digest := episode_digest(event.payload):
            digests[event.seq] = digest
    return digests


def episode_digest(payload: bytes) -> str | None:
    """The recorded digest in the `payload` of an episode event, None if it has none; raises one of `DECODE_ERRORS`."""
    return msgspec.json.decode(payload, type=_EpisodeDigest).vector_sha256 or None


def find_vector_fault(row: tuple[object, object, object], digest: str | None) -> str:
    """The reason why `row` (version, data, mask) is not the vector with `digest`; "" if it is, or without a digest."""
    version, data, mask = row
    if not (isinstance(version, str) and isinstance(data, bytes) and isinstance(mask, int)):
        return "its vector has values of the wrong type"
    if digest is None:
        return ""
    if not digest:
        return "it has a vector, although its vector was removed"
    return "" if vector_digest(StoredVector(version, data, mask)) == digest else "its vector was changed"


def digest_changes(recorded: Mapping[int, str], vectors: Mapping[int, StoredVector]) -> list[VectorDigests]:
    """The payloads of the events that record `vectors` in place of the vectors with the digests `recorded`."""
    digests = {seq: vector_digest(vector) for seq, vector in vectors.items()}
    removed = dict.fromkeys(recorded.keys() - digests.keys(), "")
    changed = [(seq, digest) for seq, digest in sorted({**digests, **removed}.items()) if recorded.get(seq) != digest]
    starts = range(0, len(changed), MAX_DIGESTS_PER_EVENT)
    return [VectorDigests(dict(changed[start : start + MAX_DIGESTS_PER_EVENT])) for start in starts]


DIGEST_EVENT_KINDS = (EPISODE, VECTORS)
"""Kinds of events that contain digests of vectors."""
