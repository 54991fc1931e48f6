"""Frames on the socket: a fixed header and a body of at most `MAX_BODY_BYTES`.

    magic "dB" (2) | version (1) | kind (1) | length (4) | sequence (8) | body (length)        little-endian

The sequence number of a connection rises by one with every frame, from 1. A frame that breaks a rule ends the
connection, because the boundary of the next frame in such a stream is unknown.
"""

from __future__ import annotations

from struct import Struct

import msgspec

MAGIC = b"dB"
VERSION = 1
MAX_BODY_BYTES = 96 * 1024
"""Longest body [bytes]: a contract (64 KiB) and its envelope."""
HEADER = Struct("<2sBBIQ")


class Frame(msgspec.Struct, frozen=True):
    """One received message; `kind` is the code of the type of its body."""

    kind: int
    sequence: int
    body: bytes


class BrokenStream(msgspec.Struct, frozen=True):
    """The reason why a stream of bytes is not a stream of frames."""

    reason: str


def encode(kind: int, sequence: int, body: bytes) -> bytes:
    """A frame as bytes."""
    return HEADER.pack(MAGIC, VERSION, kind, len(body), sequence) + body


class FrameDecoder:
    """Splits a stream of bytes into frames; `failure` is set for ever after the first fault."""

    def __init__(self) -> None:
        """Start at the beginning of a stream."""
        self._buffer = bytearray()
        self._expected_sequence = 1
        self.failure: BrokenStream | None = None

    def feed(self, data: bytes) -> None:
        """Append received `data`, which is dropped once the stream is broken."""
        if self.failure is None:
            self._buffer += data

    @property
    def n_buffered(self) -> int:
        """Number of received bytes that no returned frame contains."""
        return len(self._buffer)

    @property
    def has_frame(self) -> bool:
        """Whether `next_frame` returns something: a complete frame or a fault. Reading is needed otherwise."""
        if self.failure is not None:
            return True
        if len(self._buffer) < HEADER.size:
            return False
        magic, version, _, length, sequence = HEADER.unpack_from(self._buffer)
        is_valid = magic == MAGIC and version == VERSION and length <= MAX_BODY_BYTES
        return not is_valid or sequence != self._expected_sequence or len(self._buffer) >= HEADER.size + length

    def next_frame(self) -> Frame | BrokenStream | None:
        """The next complete frame; None if there is none yet; `BrokenStream` for ever after the first fault."""
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
