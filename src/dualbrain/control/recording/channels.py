"""Channels and messages of a recording (MCAP), and functions that read them in their order and exactly.

Every message is JSON. Finite floats round-trip bit for bit (shortest decimal form); the others are written as
`{"float": "nan"}`, `{"float": "inf"}` and `{"float": "-inf"}`, because JSON cannot represent them.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.control.recording.trace import Event, Trace, columns
from dualbrain.errors import ConfigurationError
from dualbrain.records import Attempt, Scene

Array = NDArray[np.float64]

FORMAT = "dualbrain-1"
METADATA = "dualbrain"
MAGIC = b"\x89MCAP0\r\n"
PRE_SUPERVISOR_DEFAULTS = {"delta_supervisor": 0.0, "order": 0.0, "touched": 1.0}
"""Values of the columns that recordings from before the supervisor lack."""


class EpisodeInfo(msgspec.Struct, frozen=True):
    """Data that is known when recording starts: robot, guard, instruction, versions."""

    t: float
    data: dict[str, Any]


class SceneSeen(msgspec.Struct, frozen=True):
    """One perceived scene."""

    t: float
    scene: Scene


class AttemptMade(msgspec.Struct, frozen=True):
    """One proposal of the planner and the gate's verdict."""

    t: float
    attempt: Attempt


class FilterCall(msgspec.Struct, frozen=True):
    """A call that changes the filter's tables or memory, with all its arguments.

    The calls are observe, permit, attach, detach, constrain and, after a pause of the recording, reset.

    `constrain` holds every additional row of the following ticks, including those that live barriers add per tick.
    """

    t: float
    name: str
    arguments: dict[str, Any]


class Ticks(msgspec.Struct, frozen=True, kw_only=True):
    """Consecutive ticks by column, as `trace.columns` names them; `phases` decodes the phase codes."""

    t: float
    n: int
    phases: tuple[str, ...]
    columns: dict[str, list[Any]]
    width: int | None = None

    def rows(self) -> Array:
        """The logged rows (ticks, width), bit for bit."""
        where = columns(self.n, self.width)
        rows = np.empty((len(self.columns["t"]), where["phase"].stop))
        for name, place in where.items():
            if name in self.columns or name not in PRE_SUPERVISOR_DEFAULTS:
                rows[:, place] = np.asarray(self.columns[name], np.float64).reshape(len(rows), -1)
            else:
                rows[:, place] = PRE_SUPERVISOR_DEFAULTS[name]
        return rows


Message = EpisodeInfo | SceneSeen | AttemptMade | Event | FilterCall | Ticks

CHANNELS: dict[type[msgspec.Struct], str] = {
    EpisodeInfo: "/episode",
    SceneSeen: "/scene",
    AttemptMade: "/attempt",
    Event: "/event",
    FilterCall: "/filter_call",
    Ticks: "/tick",
}
MESSAGE_TYPES = {topic: kind for kind, topic in CHANNELS.items()}


@dataclass(frozen=True, slots=True)
class RecordingState:
    """Whether a recording is complete, the number of `dropped` messages, and the `problem` that ended it, or ""."""

    complete: bool
    dropped: int
    problem: str


def encode(message: Message) -> bytes:
    """The message as JSON; arrays become lists.

    Raises `ConfigurationError` if an argument of a filter call cannot be recorded.
    """
    fast = msgspec.json.encode(message, enc_hook=_encode_array)
    if b"null" not in fast:  # msgspec writes a NaN as null
        return fast
    return msgspec.json.encode(_encode_non_finite(msgspec.to_builtins(message, enc_hook=_encode_array)))


def decode(topic: str, data: bytes) -> Message:
    """The message that `encode` wrote to `topic`."""
    if b'{"float":' not in data:
        return cast("Message", msgspec.json.decode(data, type=MESSAGE_TYPES[topic]))
    return cast("Message", msgspec.convert(_decode_non_finite(msgspec.json.decode(data)), MESSAGE_TYPES[topic]))


def _encode_array(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return cast("NDArray[Any]", value).tolist()
    raise ConfigurationError(
        "recorded argument", got=type(value).__name__, allowed="records, dataclasses, arrays, numbers, text"
    )


def _encode_non_finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else {"float": str(value)}
    if isinstance(value, dict):
        return {key: _encode_non_finite(part) for key, part in cast("dict[str, Any]", value).items()}
    return [_encode_non_finite(part) for part in cast("list[Any]", value)] if isinstance(value, list | tuple) else value


def _decode_non_finite(value: Any) -> Any:
    if isinstance(value, dict):
        table = cast("dict[str, Any]", value)
        if len(table) == 1 and table.get("float") in ("nan", "inf", "-inf"):
            return float(table["float"])
        return {key: _decode_non_finite(part) for key, part in table.items()}
    return [_decode_non_finite(part) for part in cast("list[Any]", value)] if isinstance(value, list) else value


def read_recording(path: Path) -> Iterator[Message]:
    """Every message of the file in the order of recording; a truncated file is read up to its last complete chunk.

    Raises `ConfigurationError` if the file is not a recording or is damaged.
    """
    return (decode(topic, data) for topic, data in _read_records(path) if topic in MESSAGE_TYPES)


def recording_state(path: Path) -> RecordingState:
    """The state that is stored in the file; a file without one, because its recorder was killed, is incomplete."""
    for topic, data in _read_records(path):
        if topic == METADATA:
            return msgspec.json.decode(data, type=RecordingState)
    return RecordingState(complete=False, dropped=0, problem="the recorder was ended before it could close the file")


def read_trace(path: Path) -> Trace | None:
    """The ticks and events of a recording as a `Trace`; None if it holds no tick."""
    trace: Trace | None = None
    events: list[Event] = []
    for message in read_recording(path):
        if isinstance(message, Ticks):
            trace = trace or Trace(message.n, message.width)
            trace.extend(message.rows())
            trace.phases[:] = message.phases
        elif isinstance(message, Event):
            events.append(message)
    if trace is not None:
        trace.events.extend(events)
    return trace


def _read_records(path: Path) -> Iterator[tuple[str, bytes]]:
    """(topic, JSON) of every message, then (METADATA, JSON of the recording's state) if the file was closed."""
    from mcap.exceptions import EndOfFile, McapError  # noqa: PLC0415  (reading is rare, importing this module is not)
    from mcap.records import Channel, Message, Metadata  # noqa: PLC0415
    from mcap.stream_reader import CRCValidationError, StreamReader  # noqa: PLC0415
    from zstandard import ZstdError  # noqa: PLC0415

    topics: dict[int, str] = {}
    data = path.read_bytes()
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
    except (CRCValidationError, McapError, ZstdError, struct.error, KeyError, ValueError) as error:
        raise ConfigurationError.stating(
            f"The recording {path} is damaged: {error}.", fix="Use an undamaged copy of it."
        ) from error


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
