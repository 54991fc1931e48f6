"""Frames on the socket: a fixed header, then at most `LIMIT` bytes.

    magic "dB" (2) | version (1) | kind (1) | length (4) | sequence (8) | body (length)        little-endian

The sequence number of a connection rises by one with every frame, from 1. Whatever breaks a rule ends the connection:
a stream that has lost its frame cannot be trusted to find the next one.
"""

from __future__ import annotations

from struct import Struct

import msgspec

MAGIC = b"dB"
VERSION = 1
LIMIT = 96 * 1024
"""Longest body [bytes]: a contract (64 KiB) and what stands around it."""
HEADER = Struct("<2sBBIQ")


class Frame(msgspec.Struct, frozen=True):
    """One message as it travelled; `kind` says what the body should be."""

    kind: int
    sequence: int
    body: bytes


class Broken(msgspec.Struct, frozen=True):
    """Why a stream of bytes is no stream of frames."""

    reason: str


def encode(kind: int, sequence: int, body: bytes) -> bytes:
    """A frame as bytes."""
    return HEADER.pack(MAGIC, VERSION, kind, len(body), sequence) + body


class Decoder:
    """Bytes come in as they arrive, frames go out. Holds at most one frame and what was fed beyond it."""

    def __init__(self) -> None:
        """At the beginning of a stream."""
        self._held = bytearray()
        self._expected = 1
        self.broken: Broken | None = None

    def feed(self, data: bytes) -> None:
        """Take in `data`; nothing more is kept once the stream is broken."""
        if self.broken is None:
            self._held += data

    @property
    def waiting(self) -> int:
        """Bytes that have come and are not yet taken out."""
        return len(self._held)

    def next(self) -> Frame | Broken | None:
        """The next whole frame; None if there is none yet; `Broken` for ever after the first fault."""
        if self.broken is not None or len(self._held) < HEADER.size:
            return self.broken
        magic, version, kind, length, sequence = HEADER.unpack_from(self._held)
        if magic != MAGIC or version != VERSION:
            return self._break(f"not a frame of version {VERSION}")
        if length > LIMIT:
            return self._break(f"{length} bytes, at most {LIMIT} are allowed")
        if sequence != self._expected:
            return self._break(f"sequence {sequence}, expected {self._expected}")
        end = HEADER.size + length
        if len(self._held) < end:
            return None
        body = bytes(self._held[HEADER.size : end])
        del self._held[:end]
        self._expected += 1
        return Frame(kind, sequence, body)

    def _break(self, reason: str) -> Broken:
        self.broken = Broken(reason)
        self._held.clear()
        return self.broken
