"""Running of a parser in a process with bounded memory, time and output, for untrusted files.

The process gets the argument in memory, inherits no other open file and only named environment variables, cannot write
files, and ends with the process that started it. It is a fork of a prepared process, so that imports are not repeated.
Result and argument are bytes that the caller encodes with msgspec,
never pickles. Everything that a hostile file can do to the process is a value (`ProcessFailure`); an exception of
dualbrain that the function raises (a refused file, a missing package) is raised in the caller.
"""

from __future__ import annotations

import os
import select
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import msgspec

from dualbrain.core.untrusted.bounded_file import byte_size
from dualbrain.core.untrusted.prepared_process import BoundedCall, begin_call
from dualbrain.errors import DECODE_ERRORS, ConfigurationError, DualbrainError, MissingDependencyError

READY = b"\x01"
"""First byte of the output: the modules are imported, and the clock starts."""
START_SECONDS = 120.0
"""Largest time until the process is ready [s]: imports on a loaded machine."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ProcessLimits:
    """Limits of one call: memory beyond the imported modules [bytes], processor and wall time [s], output [bytes]."""

    memory_bytes: int = 512 << 20
    seconds: float = 20.0
    output_bytes: int = 256 << 20


DEFAULT_LIMITS = ProcessLimits()


@dataclass(frozen=True, slots=True)
class ProcessFailure:
    """Why a call has no result; `reason` completes a sentence about the file: "needs more than 512 MB of memory"."""

    kind: Literal["memory", "time", "output", "nesting", "signal", "exception", "start"]
    reason: str


class ChildRequest(msgspec.Struct, frozen=True, kw_only=True):
    """The head of what the process reads: the limits of the call, and whether it yields many results."""

    memory_bytes: int
    cpu_seconds: float
    streams: bool = False


class ChildReply(msgspec.Struct, frozen=True, kw_only=True):
    """What the process writes: the result, or the kind of error, its fields and its message."""

    result: bytes | None = None
    error: Literal["", "memory", "nesting", "exception", "refused", "missing"] = ""
    what: str = ""
    got: str = ""
    allowed: str = ""
    fix: str = ""
    message: str = ""


def run_bounded(function: str, argument: bytes, limits: ProcessLimits = DEFAULT_LIMITS) -> bytes | ProcessFailure:
    """The result of the `function` ("package.module:name", bytes to bytes) for `argument`, or why there is none.

    Raises `ConfigurationError` or `MissingDependencyError` if the function raises it (as the same type, with the same
    message).
    """
    call = _begin(function, argument, limits, streams=False)
    try:
        return _await_reply(call, limits)
    finally:
        call.end()


def stream_bounded(
    function: str, argument: bytes, limits: ProcessLimits = DEFAULT_LIMITS
) -> Iterator[bytes | ProcessFailure]:
    """The results that the `function` (bytes to an iterator of bytes) yields; a failure is the last one.

    `output_bytes` limits their sum. Time in which the caller works on a result is not counted. Raises as `run_bounded`.
    """
    call = _begin(function, argument, limits, streams=True)
    try:
        yield from _await_replies(call, limits)
    finally:
        call.end()


def _begin(function: str, argument: bytes, limits: ProcessLimits, *, streams: bool) -> BoundedCall:
    request = ChildRequest(memory_bytes=limits.memory_bytes, cpu_seconds=limits.seconds, streams=streams)
    head = msgspec.msgpack.encode(request)
    return begin_call(function, len(head).to_bytes(8, "little") + head + argument)


def _await_replies(call: BoundedCall, limits: ProcessLimits) -> Iterator[bytes | ProcessFailure]:
    """Each reply is its length in 8 bytes and its content; one without a result ends the stream."""
    out = call.output
    if (failure := _await_start(call, limits)) is not None:
        yield failure
        return
    left, total = limits.seconds, 0
    while True:
        start = time.monotonic()
        head = _read_until(out, 8, start + left)
        length = int.from_bytes(head or b"", "little")
        total += length
        if total > limits.output_bytes:
            yield _output_failure(limits)
            return
        data = None if head is None else _read_until(out, length, start + left)
        left -= time.monotonic() - start
        if head is None or data is None:
            yield _time_failure(limits)
            return
        if len(head) < 8 or len(data) < length:
            yield _failure_of_end(call, limits)
            return
        reply = msgspec.msgpack.decode(data, type=ChildReply)
        if reply.error:
            found = _result_of(reply, limits)
            assert isinstance(found, ProcessFailure)
            yield found
        if reply.result is None:
            return
        yield reply.result


def _await_reply(call: BoundedCall, limits: ProcessLimits) -> bytes | ProcessFailure:
    out = call.output
    if (failure := _await_start(call, limits)) is not None:
        return failure
    data = _read_until(out, limits.output_bytes + 1, time.monotonic() + limits.seconds)
    if data is None:
        return _time_failure(limits)
    if len(data) > limits.output_bytes:
        return _output_failure(limits)
    try:
        reply = msgspec.msgpack.decode(data, type=ChildReply)
    except DECODE_ERRORS:
        return _failure_of_end(call, limits)
    return _result_of(reply, limits)


def _await_start(call: BoundedCall, limits: ProcessLimits) -> ProcessFailure | None:
    """Wait until the process is ready; the failure if it does not get so far."""
    ready = _read_until(call.output, 1, time.monotonic() + START_SECONDS)
    if ready is None:
        return ProcessFailure("start", f"cannot be read: its reader did not start within {START_SECONDS:g} s")
    return None if ready == READY else _failure_of_end(call, limits)


def _read_until(handle: int, limit: int, deadline: float) -> bytes | None:
    """At most `limit` bytes up to the end of the pipe; None if the `deadline` (monotonic) passes first."""
    parts: list[bytes] = []
    poll = select.poll()
    poll.register(handle, select.POLLIN)
    while limit:
        left = deadline - time.monotonic()
        if left <= 0.0 or not poll.poll(left * 1e3):
            return None
        if not (part := os.read(handle, min(limit, 1 << 20))):
            break
        parts.append(part)
        limit -= len(part)
    return b"".join(parts)


def _failure_of_end(call: BoundedCall, limits: ProcessLimits) -> ProcessFailure:
    """The failure of a process that ended without a reply."""
    code = call.exit_code(limits.seconds)
    if code is None:
        return ProcessFailure("start", "cannot be read: its reader was ended by another process")
    if code == -signal.SIGXCPU:
        return _time_failure(limits)
    if code < 0:
        return ProcessFailure("signal", f"cannot be read: its reader ended with signal {-code}")
    return ProcessFailure("exception", f"cannot be read: its reader ended with code {code}")


def _output_failure(limits: ProcessLimits) -> ProcessFailure:
    return ProcessFailure("output", f"contains more than {byte_size(limits.output_bytes)}")


def _time_failure(limits: ProcessLimits) -> ProcessFailure:
    return ProcessFailure("time", f"took longer than {limits.seconds:g} s")


def _result_of(reply: ChildReply, limits: ProcessLimits) -> bytes | ProcessFailure:
    match reply.error:
        case "":
            return reply.result or b""
        case "memory":
            return ProcessFailure("memory", f"needs more than {byte_size(limits.memory_bytes)} of memory")
        case "nesting":
            return ProcessFailure("nesting", "is nested too deeply")
        case "exception":
            return ProcessFailure("exception", f"cannot be read: {reply.message}")
        case "missing":
            raise MissingDependencyError(reply.what, fix=reply.fix)
        case "refused":
            raise ConfigurationError(
                reply.what, got=reply.got, allowed=reply.allowed, fix=reply.fix, sentence=reply.message
            )


def refused(error: DualbrainError) -> ChildReply:
    """The reply for an exception that is raised again in the caller."""
    if isinstance(error, MissingDependencyError):
        return ChildReply(error="missing", what=error.what, fix=error.fix)
    if isinstance(error, ConfigurationError):
        message = str(error).removesuffix(error.fix).rstrip() if error.fix else str(error)
        return ChildReply(
            error="refused",
            what=error.what,
            got=str(error.got),
            allowed=error.allowed,
            fix=error.fix,
            message=message,
        )
    return ChildReply(error="refused", what=type(error).__name__, message=str(error))
