"""Messages on the pipes between the suite's process and ours: a header of kind and length, then JSON or float64.

The module needs only NumPy, because both environments import it.
"""

from __future__ import annotations

import json
import os
import select
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

HEADER = struct.Struct("<cI")
JSON_KIND, ARRAY_KIND = b"J", b"A"
MAX_MESSAGE_BYTES = 1 << 20
"""Largest accepted message [bytes]."""


class PipeError(Exception):
    """The other process has ended, sent an invalid message, or sent nothing in time."""


def send(pipe: int, message: dict[str, Any] | Array) -> None:
    """Write one message to the file descriptor `pipe`."""
    if isinstance(message, dict):
        kind, body = JSON_KIND, json.dumps(message).encode()
    else:
        kind, body = ARRAY_KIND, np.ascontiguousarray(message, "<f8").tobytes()
    data = memoryview(HEADER.pack(kind, len(body)) + body)
    try:
        while data:
            data = data[os.write(pipe, data) :]
    except BrokenPipeError:
        raise PipeError("the other process has ended") from None


def receive(pipe: int, timeout_s: float | None = None) -> dict[str, Any] | Array:
    """Read one message from the file descriptor `pipe`: a dict, or an array (k,)."""
    if timeout_s is not None and not select.select([pipe], [], [], timeout_s)[0]:
        raise PipeError(f"no message within {timeout_s:g} s")
    kind, length = HEADER.unpack(_read_exactly(pipe, HEADER.size))
    if length > MAX_MESSAGE_BYTES or kind not in (JSON_KIND, ARRAY_KIND):
        raise PipeError(f"invalid message header: kind {kind!r}, {length} bytes")
    body = _read_exactly(pipe, length)
    return json.loads(body) if kind == JSON_KIND else np.frombuffer(body, "<f8")


def _read_exactly(pipe: int, count: int) -> bytes:
    parts: list[bytes] = []
    while count:
        part = os.read(pipe, count)
        if not part:
            raise PipeError("the other process has ended")
        parts.append(part)
        count -= len(part)
    return b"".join(parts)
