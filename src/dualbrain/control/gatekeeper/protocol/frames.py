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
MAX_BODY_BYTES = 96 * 1024
"""Longest body [bytes]: a contract (64 KiB) and what stands around it."""
HEADER = Struct("<2sBBIQ")


class Frame(msgspec.Struct, frozen=True):
    """One message as it travelled; `kind` says what the body should be."""

    kind: int
    sequence: int
    body: bytes


class BrokenStream(msgspec.Struct, frozen=True):
    """Why a stream of bytes is no stream of frames."""

    reason: str


def encode(kind: int, sequence: int, body: bytes) -> bytes:
    """A frame as bytes."""
    return HEADER.pack(MAGIC, VERSION, kind, len(body), sequence) + body


class FrameDecoder:
    """Bytes come in as they arrive, frames go out. Holds at most one frame and what was fed beyond it."""

    def __init__(self) -> None:
        """At the beginning of a stream."""
        self._buffer = bytearray()
        self._expected_sequence = 1
        self.failure: BrokenStream | None = None

    def feed(self, data: bytes) -> None:
        """Take in `data`; nothing more is kept once the stream is broken."""
        if self.failure is None:
            self._buffer += data

    @property
    def n_buffered(self) -> int:
        """Bytes that have come and are not yet taken out."""
        return len(self._buffer)

    def next_frame(self) -> Frame | BrokenStream | None:
        """The next whole frame; None if there is none yet; `Broken` for ever after the first fault."""
        if self.failure is not None or len(self._buffer) < HEADER.size:
            return self.failure
        magic, version, kind, length, sequence = HEADER.unpack_from(self._buffer)
        if magic != MAGIC or version != VERSION:
            return self._fail(f"not a frame of version {VERSION}")
        if length > MAX_BODY_BYTES:
            return self._fail(f"{length} bytes, at most {MAX_BODY_BYTES} are allowed")
        if sequence != self._expected_sequence:
            return self._fail(f"sequence {sequence}, expected {self._expected_sequence}")
        end = HEADER.size + length
        if len(self._buffer) < end:
            return None
        body = bytes(self._buffer[HEADER.size : end])
        del self._buffer[:end]
        self._expected_sequence += 1
        return Frame(kind, sequence, body)

    def _fail(self, reason: str) -> BrokenStream:
        self.failure = BrokenStream(reason)
        self._buffer.clear()
        return self.failure
