"""Frames of the link to a target: COBS, CRC-32 and a SipHash tag; the layout is stated in firmware/protocol/frame.h."""

from __future__ import annotations

import hmac
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from struct import Struct

VERSION = 1
MAX_PAYLOAD = 1000
_HEADER, _CRC = Struct("<BBHI"), Struct("<I")
TAG_SIZE = 8
_cobs = import_module("cobs.cobs")  # both packages have no types
_siphash = import_module("siphash24")
MAX_ENCODED = MAX_PAYLOAD + 40
"""Bytes after which a frame without a delimiter is discarded."""


@dataclass(frozen=True, slots=True)
class Frame:
    """A received frame: type, sequence number, payload, and whether its tag is valid under the key of the reader."""

    type: int
    sequence: int
    payload: bytes


def tag(data: bytes, key: bytes) -> bytes:
    """SipHash-2-4 of `data` under a key of 16 bytes."""
    return bytes(_siphash.siphash24(data, key=key).digest())


def encode_frame(kind: int, sequence: int, payload: bytes, key: bytes) -> bytes:
    """The bytes on the link, with the delimiter."""
    body = _HEADER.pack(kind, VERSION, 0, sequence) + payload
    body += tag(body, key)
    return bytes(_cobs.encode(body + _CRC.pack(zlib.crc32(body)))) + b"\0"


def decode_frame(encoded: bytes, key: bytes) -> Frame | None:
    """The frame of one delimited piece; None if it is torn, forged or of another version."""
    try:
        data = bytes(_cobs.decode(encoded))
    except _cobs.DecodeError:
        return None
    if len(data) < _HEADER.size + TAG_SIZE + _CRC.size:
        return None
    body, payload_end = data[: -_CRC.size], len(data) - _CRC.size - TAG_SIZE
    kind, version, zero, sequence = _HEADER.unpack_from(data)
    if zlib.crc32(body) != _CRC.unpack_from(data, len(body))[0] or version != VERSION or zero != 0:
        return None
    if not hmac.compare_digest(tag(data[:payload_end], key), data[payload_end : payload_end + TAG_SIZE]):
        return None
    return Frame(kind, sequence, data[_HEADER.size : payload_end])


class FrameReader:
    """Splits a stream of bytes at the delimiters."""

    def __init__(self) -> None:
        """Start without bytes."""
        self._rest = b""

    def feed(self, data: bytes) -> Iterator[bytes]:
        """The completed pieces without their delimiters; a piece that is too long is discarded."""
        *pieces, rest = (self._rest + data).split(b"\0")
        self._rest = rest if len(rest) <= MAX_ENCODED else b""
        yield from (piece for piece in pieces if piece)
