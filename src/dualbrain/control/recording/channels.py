"""Channels and messages of a recording (MCAP), and functions that read them in their order and exactly.

Every message is JSON. Finite floats round-trip bit for bit (shortest decimal form); the others are written as
`{"float": "nan"}`, `{"float": "inf"}` and `{"float": "-inf"}`, because JSON cannot represent them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.control.recording.trace import Event, Trace, columns
from dualbrain.core.untrusted.bounded_file import FileRefusal, read_regular_file
from dualbrain.core.untrusted.bounded_process import DEFAULT_LIMITS, ProcessFailure, ProcessLimits, stream_bounded
from dualbrain.errors import DECODE_ERRORS, ConfigurationError
from dualbrain.records import Attempt, Scene

Array = NDArray[np.float64]

FORMAT = "dualbrain-1"
METADATA = "dualbrain"
MAX_JOINTS, MAX_WIDTH = 64, 256
MAX_INTEGER = 2**63
"""Largest number of joints, and largest length of a configuration, of a robot in a recording."""
OWN_RECORDING_LIMITS = ProcessLimits(memory_bytes=4 << 30, seconds=600.0, output_bytes=16 << 30)
"""Limits for a recording that this program has just written itself, which may be of a long run."""
UNMEASURED_COLUMNS = ("torques", "wrench")
"""Columns that a recording lacks if the robot does not measure them, and recordings from before force sensing."""
COLUMN_DEFAULTS = {"delta_supervisor": 0.0, "order": 0.0, "touched": 1.0} | dict.fromkeys(UNMEASURED_COLUMNS, math.nan)
"""Values of the columns that a recording may lack: `UNMEASURED_COLUMNS`, and in recordings from before the supervisor
the others."""


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


class Ticks(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Consecutive ticks by column, as `trace.columns` names them; `phases` decodes the phase codes.

    A `width` of None is not written: `encode` searches for NaN only if there is a null.
    """

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
            if name in self.columns or name not in COLUMN_DEFAULTS:
                rows[:, place] = np.asarray(self.columns[name], np.float64).reshape(len(rows), -1)
            else:
                rows[:, place] = COLUMN_DEFAULTS[name]
        return rows


class ThreadTicks(msgspec.Struct, frozen=True):
    """Ticks of a control thread by column: what the robot was commanded, beside the ticks of the loop above it.

    Columns: number of the tick, robot time [µs], numbers of the joint state and of the loop's control, action and check
    of the thread's supervisor, whether the drive is on, and the control u (n,) [rad/s].
    """

    t: float
    columns: dict[str, list[Any]]


Message = EpisodeInfo | SceneSeen | AttemptMade | Event | FilterCall | Ticks | ThreadTicks

CHANNELS: dict[type[msgspec.Struct], str] = {
    EpisodeInfo: "/episode",
    SceneSeen: "/scene",
    AttemptMade: "/attempt",
    Event: "/event",
    FilterCall: "/filter_call",
    Ticks: "/tick",
    ThreadTicks: "/thread_tick",
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


def read_recording(path: Path, limits: ProcessLimits = DEFAULT_LIMITS) -> Iterator[Message]:
    """Every message of the file in the order of recording; a truncated file is read up to its last complete chunk.

    The file is unpacked in a process within `limits`. Raises `ConfigurationError` if the file is not a recording, is
    damaged, or exceeds the limits.
    """
    for topic, data in _read_records(path, limits):
        if topic in MESSAGE_TYPES:
            yield _decode_checked(path, topic, data)


def recording_state(path: Path, limits: ProcessLimits = DEFAULT_LIMITS) -> RecordingState:
    """The state that is stored in the file; a file without one, because its recorder was killed, is incomplete."""
    for topic, data in _read_records(path, limits):
        if topic == METADATA:
            try:
                return msgspec.json.decode(data, type=RecordingState)
            except DECODE_ERRORS as error:
                raise damaged_recording(path, error) from error
    return RecordingState(complete=False, dropped=0, problem="the recorder was ended before it could close the file")


def read_trace(path: Path, limits: ProcessLimits = DEFAULT_LIMITS) -> Trace | None:
    """The ticks and events of a recording as a `Trace`; None if it holds no tick."""
    trace: Trace | None = None
    events: list[Event] = []
    for message in read_recording(path, limits):
        if isinstance(message, Ticks):
            trace = trace or Trace(message.n, message.width)
            trace.extend(message.rows())
            trace.phases[:] = message.phases
        elif isinstance(message, Event):
            events.append(message)
    if trace is not None:
        trace.events.extend(events)
    return trace


def damaged_recording(path: Path, reason: object) -> ConfigurationError:
    """The error of a recording that cannot be used."""
    problem = f"{type(reason).__name__}: {reason}" if isinstance(reason, Exception) else str(reason)
    sentence = f"The recording {path} is damaged: {' '.join(problem.split())[:200]}."
    return ConfigurationError.stating(sentence, fix="Use an undamaged copy of it.")


def _decode_checked(path: Path, topic: str, data: bytes) -> Message:
    """The message in `data`; ticks have consistent sizes. Raises `ConfigurationError`."""
    try:
        message = decode(topic, data)
    except (*DECODE_ERRORS, ValueError) as error:
        raise damaged_recording(path, error) from error
    if isinstance(message, Ticks) and (problem := _ticks_problem(message)):
        raise damaged_recording(path, problem)
    return message


def _ticks_problem(ticks: Ticks) -> str:
    """The inconsistency of the sizes or the wrong number of `ticks`; "" if there is none."""
    if not 1 <= ticks.n <= MAX_JOINTS or not 1 <= (ticks.width or ticks.n) <= MAX_WIDTH:
        return f"ticks of {ticks.n} joints and width {ticks.width}"
    where = columns(ticks.n, ticks.width)
    if missing := set(where) - set(ticks.columns) - set(COLUMN_DEFAULTS):
        return f"ticks without {min(missing)}"
    count = len(ticks.columns["t"])
    for name, place in where.items():
        values = ticks.columns.get(name)
        width = place.stop - place.start
        if values is not None and not _is_column(values, count, width):
            return f"a column {name} that is not {count} times {width} numbers"
    return ""


def _is_column(values: list[Any], count: int, width: int) -> bool:
    """Whether `values` are `count` numbers, or lists of `width` numbers."""
    if len(values) != count:
        return False
    if width == 1 and all(map(_is_number, values)):
        return True
    return all(
        isinstance(row, list) and len(cast("list[Any]", row)) == width and all(map(_is_number, cast("list[Any]", row)))
        for row in values
    )


def _is_number(value: Any) -> bool:
    """Whether `value` is a number that a double can represent; JSON integers may have any number of digits."""
    return isinstance(value, float) or (isinstance(value, int) and -MAX_INTEGER <= value <= MAX_INTEGER)


def _read_records(path: Path, limits: ProcessLimits) -> Iterator[tuple[str, bytes]]:
    """(topic, JSON) of every message, then (METADATA, JSON of the recording's state) if the file was closed."""
    import_module("mcap")  # a missing package is reported before a process is started
    if isinstance(refusal := read_regular_file(path, 0), FileRefusal) and refusal.kind != "too large":
        raise ConfigurationError.stating(refusal.sentence, fix="Name a recording of dualbrain.")
    argument = msgspec.msgpack.encode((str(path.resolve()), limits.memory_bytes // 2, str(path)))
    for found in stream_bounded("dualbrain.control.recording.unpacking:unpack_records", argument, limits):
        if isinstance(found, ProcessFailure):
            raise ConfigurationError.stating(
                f"The recording {path} {found.reason}.", fix="Use an undamaged recording of dualbrain."
            )
        yield from msgspec.msgpack.decode(found, type=list[tuple[str, bytes]])
