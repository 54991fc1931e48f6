"""Unpacking of the records of a recording (MCAP) in a bounded process, which `channels` starts."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from importlib import import_module
from io import BytesIO
from pathlib import Path

import msgspec

from dualbrain.control.recording.channels import METADATA, damaged_recording
from dualbrain.core.untrusted.bounded_file import read_bounded_file
from dualbrain.errors import ConfigurationError, MissingDependencyError

MAGIC = b"\x89MCAP0\r\n"
BATCH_BYTES = 1 << 20
"""Bytes of messages that are handed over together."""


def prepare_process(_: str) -> None:
    """Import the packages that read the file."""
    try:
        import_module("mcap.stream_reader")
        import_module("zstandard")
    except ImportError as error:
        fix = "Install it with `pip install 'dualbrain[view]'`."
        raise MissingDependencyError("The package mcap", fix=fix) from error


def unpack_records(argument: bytes) -> Iterator[bytes]:
    """Batches of (topic, JSON) of every message, then (METADATA, JSON of the state) if the file was closed.

    The argument is an encoded triple: the path, the largest size of the file [bytes], and the name for messages.
    """
    path, limit, name = msgspec.msgpack.decode(argument, type=tuple[str, int, str])
    batch: list[tuple[str, bytes]] = []
    size = 0
    for topic, data in _records(read_bounded_file(Path(path), limit), Path(name)):
        batch.append((topic, data))
        size += len(data)
        if size >= BATCH_BYTES:
            yield msgspec.msgpack.encode(batch)
            batch, size = [], 0
    yield msgspec.msgpack.encode(batch)


def _records(data: bytes, path: Path) -> Iterator[tuple[str, bytes]]:
    from mcap.exceptions import EndOfFile, McapError  # noqa: PLC0415  (reading is rare, importing this module is not)
    from mcap.records import Channel, Message, Metadata  # noqa: PLC0415
    from mcap.stream_reader import CRCValidationError, StreamReader  # noqa: PLC0415
    from zstandard import ZstdError  # noqa: PLC0415

    topics: dict[int, str] = {}
    if not data.startswith(MAGIC):
        raise ConfigurationError.stating(f"The file {path} is not an MCAP file.", fix="Name a recording of dualbrain.")
    try:
        for record in StreamReader(BytesIO(data[: _complete_length(data)]), validate_crcs=True).records:
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Message):
                yield topics[record.channel_id], record.data
            elif isinstance(record, Metadata) and record.name == METADATA:
                yield METADATA, record.metadata["state"].encode()
    except EndOfFile:
        return
    except (CRCValidationError, McapError, ZstdError, struct.error, KeyError, ValueError, OverflowError) as error:
        raise damaged_recording(path, error) from error


def _complete_length(data: bytes) -> int:
    """End [bytes] of the last complete record; a record is one byte of kind, eight of length, then its content."""
    if data.endswith(MAGIC) and len(data) > len(MAGIC):
        return len(data)
    end = len(MAGIC)
    while (start := end + 9) <= len(data):
        length = int.from_bytes(data[end + 1 : start], "little")
        if start + length > len(data):
            break
        end = start + length
    return end
