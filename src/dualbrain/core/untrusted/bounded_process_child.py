"""The prepared process, and what its forks do: each limits itself, runs the function once and writes its reply."""

from __future__ import annotations

import ctypes
import gc
import logging
import os
import resource
import select
import signal
import socket
import warnings
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any, NoReturn

import msgspec

from dualbrain.core.untrusted.bounded_process import READY, ChildReply, ChildRequest, refused
from dualbrain.core.untrusted.prepared_process import CHANNEL, IDLE_SECONDS, ORDER, STATUS, kill_group
from dualbrain.errors import DualbrainError

_PR_SET_PDEATHSIG = 1
_PAGE_BYTES = os.sysconf("SC_PAGESIZE")
_RESERVE_BYTES = 8 << 20
"""Memory that is freed when memory runs out, so that the reply can be written."""
_MAX_OPEN_FILES = 64
_MAX_MESSAGE = 300


def main(function: str) -> None:
    """Import the `function` ("package.module:name"), then fork a process for each call until the caller ends."""
    os.closerange(CHANNEL + 1, os.sysconf("SC_OPEN_MAX"))
    os.chdir("/")
    channel = socket.socket(fileno=CHANNEL)
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    try:
        prepared: Callable[[bytes], Any] | ChildReply = _import_function(function)
    except Exception as error:
        prepared = refused(error) if isinstance(error, DualbrainError) else _reply_for(error)
    gc.freeze()
    while (handles := _next_call(channel)) is not None:
        child = os.fork()
        if child == 0:
            channel.close()
            _serve(prepared, *handles)
        for handle in handles:
            os.close(handle)
        order = channel.recv(ORDER.size)
        status = _collect(child, ORDER.unpack(order)[0] if order else 0.0)
        if not order:
            return
        if isinstance(prepared, ChildReply):
            channel.shutdown(socket.SHUT_RD)  # the next call imports again: the package may be there by then
        channel.send(STATUS.pack(status))


def _next_call(channel: socket.socket) -> tuple[int, int] | None:
    """The files of the next call; None if the caller has ended, or for want of calls."""
    channel.settimeout(IDLE_SECONDS)
    try:
        message, handles, _, _ = socket.recv_fds(channel, 16, 2)
    except TimeoutError:
        channel.shutdown(socket.SHUT_RD)  # from here on the caller starts another one; a call that it has sent is done
        message, handles, _, _ = socket.recv_fds(channel, 16, 2)
    channel.settimeout(None)
    return (handles[0], handles[1]) if message else None


def _collect(child: int, seconds: float) -> int:
    """The exit code of the child; that of SIGXCPU if it ran for longer than `seconds` and was killed."""
    handle = os.pidfd_open(child)
    try:
        poll = select.poll()
        poll.register(handle, select.POLLIN)
        in_time = bool(poll.poll(seconds * 1e3))
    finally:
        os.close(handle)
    kill_group(child)  # also what the child has started
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return code if in_time else -signal.SIGXCPU


def _serve(prepared: Callable[[bytes], Any] | ChildReply, source: int, target: int) -> NoReturn:
    """Read the request and the argument, write the reply, and exit."""
    starter = os.getppid()
    os.setsid()
    _end_with_parent(starter)
    with os.fdopen(source, "rb") as file:
        length = int.from_bytes(file.read(8), "little")
        request = msgspec.msgpack.decode(file.read(length), type=ChildRequest)
        argument = file.read()
    if isinstance(prepared, ChildReply):
        reply = msgspec.msgpack.encode(prepared)
        _write_all(target, READY + (_framed(reply) if request.streams else reply))
        os._exit(0)
    reserve = [bytearray(_RESERVE_BYTES)]
    _limit(request)
    _write_all(target, READY)
    if request.streams:
        _stream(prepared, argument, reserve, target)
    else:
        _write_all(target, msgspec.msgpack.encode(_call(prepared, argument, reserve)))
    os._exit(0)


def _stream(function: Callable[[bytes], Any], argument: bytes, reserve: list[bytearray], reply_to: int) -> None:
    """Write each result as it comes, and at the end a reply without a result."""
    results: list[Iterator[bytes]] = []

    def begin(data: bytes) -> bytes:
        results.append(iter(function(data)))
        return b""

    def proceed(_: bytes) -> bytes | None:
        return next(results[0], None)

    reply = _call(begin, argument, reserve)
    while not reply.error:
        reply = _call(proceed, b"", reserve)
        _write_all(reply_to, _framed(msgspec.msgpack.encode(reply)))
        if reply.result is None:
            return
    _write_all(reply_to, _framed(msgspec.msgpack.encode(reply)))


def _framed(data: bytes) -> bytes:
    return len(data).to_bytes(8, "little") + data


def _import_function(name: str) -> Callable[[bytes], Any]:
    """The function "module:name"; `prepare_process` of its module imports what it needs, before the limits apply."""
    module, _, attribute = name.partition(":")
    imported = import_module(module)
    prepare = getattr(imported, "prepare_process", None)
    if prepare is not None:
        prepare(attribute)
    return getattr(imported, attribute)


def _end_with_parent(parent: int) -> None:
    """Let the kernel end this process when its parent ends; end now if that happened already."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(1)


def _limit(request: ChildRequest) -> None:
    """Limit memory, processor time, open files, files that are written, and core dumps."""
    with open("/proc/self/statm", encoding="ascii") as file:
        used = int(file.read().split()[0]) * _PAGE_BYTES
    memory = used + request.memory_bytes
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    usage = resource.getrusage(resource.RUSAGE_SELF)
    cpu = int(usage.ru_utime + usage.ru_stime + request.cpu_seconds) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (cpu, cpu + 1))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_NOFILE, (_MAX_OPEN_FILES, _MAX_OPEN_FILES))


def _call(function: Callable[[bytes], bytes | None], argument: bytes, reserve: list[bytearray]) -> ChildReply:
    """The reply of the function: every exception is one, also those that are no `Exception` (panics of extensions)."""
    try:
        return ChildReply(result=function(argument))
    except MemoryError:
        reserve.clear()
        reply = ChildReply(error="memory")
    except RecursionError:
        reply = ChildReply(error="nesting")
    except DualbrainError as error:
        reply = refused(error)
    except BaseException as error:
        reserve.clear()
        reply = _reply_for(error)
    gc.collect()
    return reply


def _reply_for(error: BaseException) -> ChildReply:
    text = " ".join(f"{type(error).__name__}: {error}".split())[:_MAX_MESSAGE]
    lacks_memory = "memory" in text.lower() and ("alloc" in text.lower() or "out of memory" in text.lower())
    return ChildReply(error="memory") if lacks_memory else ChildReply(error="exception", message=text)


def _write_all(handle: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(handle, view) :]
