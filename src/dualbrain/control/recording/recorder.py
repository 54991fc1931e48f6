"""The recorder: writes an MCAP file in its own thread, so that the control loop never waits for a disk.

The control thread only puts references into a bounded queue (ticks in batches of 50). The recording of a killed process
is readable up to its last chunk; chunks are flushed every half second of recorded time.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from queue import Full, Queue
from threading import Thread
from types import TracebackType
from typing import Any, BinaryIO, Literal, NamedTuple, Self, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.control.recording.channels import (
    CHANNELS,
    FORMAT,
    METADATA,
    UNMEASURED_COLUMNS,
    AttemptMade,
    EpisodeInfo,
    FilterCall,
    Message,
    RecordingState,
    SceneSeen,
    ThreadTicks,
    Ticks,
    encode,
)
from dualbrain.control.recording.recording_file import RecordingFile
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.core.storage.reserved_space import ReservedSpace
from dualbrain.records import Attempt, Scene

Array = NDArray[np.float64]

BATCH_TICKS = 50
"""Ticks of one /tick message."""
FLUSH_PERIOD = 0.5
"""Recorded time [s] between two flushes of the file."""

SLOW_DISK = "the disk was slower than the control loop"
"""Reason of lost messages."""

THREAD_COLUMNS = {
    "tick": "tick",
    "now_us": "now_us",
    "state": "state_sequence",
    "control": "control_number",
    "action": "action",
    "check": "check",
    "drive": "drive_enable",
}
"""Columns of `ThreadTicks`, and the fields of `dbk_tick_record` that they hold."""


class ThreadRecords(NamedTuple):
    """Records of a control thread at `t` [s]; the thread of the writer makes a message of them."""

    t: float
    records: NDArray[Any]


Item = Message | list[Array] | ThreadRecords
"""An item of the queue: a message, or a batch of rows or records; the number of items lost before it goes with it."""


class Recorder:
    """Writes one episode to `path`.

    `when_full` defines the behaviour of a full queue: "drop" loses the message, counts it and marks the gap in the file
    (live control); "wait" waits for the disk (lockstep simulation).
    """

    def __init__(
        self,
        path: Path,
        trace: Trace,
        *,
        capacity: int = 1024,
        when_full: Literal["drop", "wait"] = "drop",
        reserve: ReservedSpace | None = None,
    ) -> None:
        """Create the file; rows given to `tick` must come from `trace`. Raises `FileWriteError`.

        `reserve` is the space for the end of the recording on a disk that has become full; it is released at the end.
        """
        self.path = path
        self.dropped = self._reported_drops = 0
        self._trace = trace
        self._blocking = when_full == "wait"
        self._queue: Queue[tuple[int, Item] | None] = Queue(capacity)
        self._pending: list[Array] = []
        self._state: RecordingState | None = None
        self._overflows = False
        self._file = _McapFile(path, reserve)
        self._thread = Thread(target=self._drain, name="recorder", daemon=True)
        self._thread.start()

    @property
    def failure(self) -> str:
        """Why ticks are or may be lost, as a sentence; "" while everything is recorded. Costs no waiting."""
        if failure := self._file.failure:
            return failure
        return f"The recording {self.path} is incomplete: {SLOW_DISK}." if self._overflows else ""

    # --- called by the control thread ---------------------------------------------------------------------------

    def tick(self, row: Array) -> None:
        """Record one row of the trace."""
        self._pending.append(row)
        if len(self._pending) >= BATCH_TICKS:
            self._put_pending()

    def call(self, t: float, name: str, **arguments: Any) -> None:
        """Record a call that changes the filter's tables; mutable arguments are copied at once."""
        self._put(FilterCall(t, name, {key: _snapshot(value) for key, value in arguments.items()}))

    def event(self, event: Event) -> None:
        """Record an event, as `Trace.note` returns it."""
        self._put(event)

    def scene(self, scene: Scene) -> None:
        """Record a perceived scene at its stamp."""
        self._put(SceneSeen(scene.stamp, scene))

    def attempt(self, t: float, attempt: Attempt) -> None:
        """Record a proposal of the planner with the gate's verdict."""
        self._put(AttemptMade(t, attempt))

    def thread_ticks(self, t: float, records: NDArray[Any]) -> None:
        """Record ticks of a control thread (`dbk_tick_record`)."""
        self._put_pending()
        self._enqueue(ThreadRecords(t, records))

    def episode(self, t: float, data: Mapping[str, Any]) -> None:
        """Record the data that is known when the episode starts."""
        self._put(EpisodeInfo(t, dict(data)))

    def close(self) -> RecordingState:
        """Write the rest and close the file; returns whether the recording is complete. May be called repeatedly."""
        if self._state is None:
            self._put_pending()
            self._queue.put(None)
            self._thread.join()
            self._state = self._file.finish(self.dropped)
        return self._state

    def __enter__(self) -> Self:
        """The recorder itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Close the file."""
        self.close()

    def _put(self, item: Message) -> None:
        self._put_pending()
        self._enqueue(item)

    def _put_pending(self) -> None:
        if self._pending:
            batch, self._pending = self._pending, []
            self._enqueue(batch)

    def _enqueue(self, item: Item) -> None:
        try:
            self._queue.put((self.dropped - self._reported_drops, item), block=self._blocking)
            self._reported_drops = self.dropped
            self._overflows = False
        except Full:
            self.dropped += 1
            self._overflows = True

    # --- the writer's thread -------------------------------------------------------------------------------------

    def _drain(self) -> None:
        while (entry := self._queue.get()) is not None:
            try:
                self._write(*entry)
            except Exception as error:  # the thread must continue to empty the queue: the control loop may wait for it
                self._file.fail(error)

    def _write(self, lost: int, item: Item) -> None:
        message = self._message(item)
        if lost:
            gap = f"{lost} messages were lost here: {SLOW_DISK}"
            self._file.write(Event(message.t, "recorder", gap, {"lost": lost}))
        self._file.write(message)

    def _message(self, item: Item) -> Message:
        if isinstance(item, ThreadRecords):
            columns = {name: item.records[field].tolist() for name, field in THREAD_COLUMNS.items()}
            return ThreadTicks(item.t, {**columns, "u": item.records["u"][:, : self._trace.n].tolist()})
        return self._ticks(item) if isinstance(item, list) else item

    def _ticks(self, batch: list[Array]) -> Ticks:
        rows = np.stack(batch)
        table = {
            name: (rows[:, where] if where.stop - where.start > 1 else rows[:, where.start]).tolist()
            for name, where in self._trace.columns.items()
            if name not in UNMEASURED_COLUMNS or not np.isnan(rows[:, where]).all()
        }
        return Ticks(
            t=float(rows[0, 0]),
            n=self._trace.n,
            phases=tuple(self._trace.phases),
            columns=table,
            width=self._trace.width,
        )


class _McapFile:
    """An open MCAP file. An error is stored as `problem`, which ends the recording, and not raised: the robot moves."""

    def __init__(self, path: Path, reserve: ReservedSpace | None) -> None:
        from mcap.writer import CompressionType, Writer  # noqa: PLC0415  (heavy imports are lazy)

        self.problem = ""
        self._path = path
        self._stream = RecordingFile(path, reserve)
        self._writer = Writer(cast("BinaryIO", self._stream), compression=CompressionType.ZSTD)
        self._writer.start(profile="", library=FORMAT)
        self._channels = {topic: self._channel(kind, topic) for kind, topic in CHANNELS.items()}
        self._sequence, self._last_flush = 0, 0.0
        self._writer.flush()

    def _channel(self, kind: type[msgspec.Struct], topic: str) -> int:
        schema = msgspec.json.encode(msgspec.json.schema(kind))
        identity = self._writer.register_schema(kind.__name__, "jsonschema", schema)
        return self._writer.register_channel(topic, "json", identity)

    @property
    def failure(self) -> str:
        """The first failed write, from which the reserved space may have saved the recording, or the problem."""
        if self._stream.failure or not self.problem:
            return self._stream.failure
        return f"The recording {self._path} cannot be written: {self.problem}."

    def fail(self, error: Exception) -> None:
        self.problem = self.problem or f"{type(error).__name__}: {error}"

    def write(self, message: Message) -> None:
        if self.problem:
            return
        try:
            stamp = max(0, round(message.t * 1e9))
            self._writer.add_message(
                self._channels[CHANNELS[type(message)]], stamp, encode(message), stamp, self._sequence
            )
            self._sequence += 1
            if abs(message.t - self._last_flush) >= FLUSH_PERIOD:
                self._writer.flush()
                self._last_flush = message.t
        except Exception as error:  # no failure of the recording may reach the control loop
            self.fail(error)

    def finish(self, dropped: int) -> RecordingState:
        state = RecordingState(not dropped and not self.problem, dropped, self.problem)
        try:
            try:
                self._writer.add_metadata(METADATA, {"format": FORMAT, "state": msgspec.json.encode(state).decode()})
                self._writer.finish()
            finally:
                self._stream.close()
        except OSError as error:
            state = RecordingState(complete=False, dropped=dropped, problem=self.problem or str(error))
        return state


def _snapshot(value: object) -> object:
    """A copy of mutable values (arrays, lists); frozen records, and tuples of them, are returned unchanged."""
    frozen = isinstance(value, int | float | str | tuple | msgspec.Struct)
    return cast("object", value) if frozen else copy.deepcopy(value)
