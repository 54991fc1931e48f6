"""The process that `bounded_process.run_bounded` starts: it limits itself, runs one function and writes its reply."""

from __future__ import annotations

import ctypes
import gc
import logging
import os
import resource
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import msgspec

from dualbrain.core.untrusted.bounded_process import READY, ChildReply, ChildRequest, refused
from dualbrain.errors import DualbrainError

_PR_SET_PDEATHSIG = 1
_PAGE_BYTES = os.sysconf("SC_PAGESIZE")
_RESERVE_BYTES = 8 << 20
"""Memory that is freed when memory runs out, so that the reply can be written."""
_MAX_OPEN_FILES = 64
_MAX_MESSAGE = 300


def main() -> None:
    """Read the request and the argument from standard input, write the reply to standard output, and exit."""
    reply_to = os.dup(1)
    os.dup2(2, 1)  # what a library prints is not part of the reply
    with os.fdopen(0, "rb", closefd=False) as source:
        length = int.from_bytes(source.read(8), "little")
        request = msgspec.msgpack.decode(source.read(length), type=ChildRequest)
        _end_with_parent(request.parent)
        logging.disable(logging.CRITICAL)
        warnings.simplefilter("ignore")
        try:
            function = _import_function(request.function)
        except Exception as error:
            known = refused(error) if isinstance(error, DualbrainError) else _reply_for(error)
            reply = msgspec.msgpack.encode(known)
            _write_all(reply_to, READY + (_framed(reply) if request.streams else reply))
            os._exit(0)
        argument = source.read()
    reserve = [bytearray(_RESERVE_BYTES)]
    _limit(request)
    _write_all(reply_to, READY)
    if request.streams:
        _stream(function, argument, reserve, reply_to)
    else:
        reply = _call(function, argument, reserve)
        _write_all(reply_to, msgspec.msgpack.encode(reply))
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


if __name__ == "__main__":
    sys.exit("This module is started by dualbrain.core.untrusted.bounded_process.")
