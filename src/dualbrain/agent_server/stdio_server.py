"""MCP over standard input and output: one JSON message per line, until the input closes.

Standard output carries messages only. `StandardStreams` must be claimed before other processes are started: everything
that they and this process print then goes to standard error.
"""

from __future__ import annotations

import io
import os
import signal
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import suppress
from threading import Thread
from typing import Any, cast

import anyio
import anyio.from_thread
import anyio.lowlevel
from mcp.server.lowlevel import Server
from mcp.server.stdio import stdio_server

from dualbrain.agent_server.contract_text import MALFORMED, MAX_MESSAGE_BYTES, contract_as_text

BUFFERED_LINES = 16
"""Lines that wait at most for the server before the reader waits."""
READ_BYTES = 1 << 16
STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)


class StandardStreams:
    """The descriptors of standard input and output; standard output is replaced by standard error."""

    def __init__(self) -> None:
        """Claim both."""
        sys.stdout.flush()
        self.input, self.output = os.dup(0), os.dup(1)
        os.dup2(2, 1)


class LineReader:
    """The messages of a descriptor as text, with contracts as text; a thread reads them until the input ends."""

    def __init__(self, descriptor: int, on_end: Callable[[], None]) -> None:
        """Read from `descriptor` when the messages are iterated; a thread calls `on_end` at the end of the input."""
        self._descriptor, self._on_end = descriptor, on_end

    async def __aiter__(self) -> AsyncIterator[str]:
        """Each line, until the input ends."""
        send, receive = anyio.create_memory_object_stream[str](BUFFERED_LINES)
        token = anyio.lowlevel.current_token()

        def read() -> None:
            try:
                for line in read_lines(self._descriptor):
                    anyio.from_thread.run(send.send, contract_as_text(line).decode("utf-8", "replace"), token=token)
            except (RuntimeError, OSError, anyio.BrokenResourceError, anyio.ClosedResourceError):
                pass  # the server has ended, or the input cannot be read
            self._on_end()
            with suppress(RuntimeError):  # the server has ended
                anyio.from_thread.run_sync(send.close, token=token)

        Thread(target=read, name="standard input", daemon=True).start()
        async with receive:
            async for line in receive:
                yield line


def read_lines(descriptor: int) -> Iterator[bytes]:
    """The lines of `descriptor` without their ends, until its end; a line that is too long becomes `MALFORMED`."""
    rest, too_long = b"", False
    while data := os.read(descriptor, READ_BYTES):
        *lines, rest = (rest + data).split(b"\n")
        for line in lines:
            yield MALFORMED if too_long or len(line) > MAX_MESSAGE_BYTES else line
            too_long = False
        if len(rest) > MAX_MESSAGE_BYTES:
            rest, too_long = b"", True


def serve_stdio(server: Server[Any], streams: StandardStreams, *, on_end: Callable[[], None] = lambda: None) -> None:
    """Serve one client until the input closes, or until SIGTERM, SIGINT or SIGHUP; `on_end` is then called at once."""
    anyio.run(_serve, server, streams, on_end)


async def _serve(server: Server[Any], streams: StandardStreams, on_end: Callable[[], None]) -> None:
    output = io.TextIOWrapper(os.fdopen(streams.output, "wb", closefd=False), encoding="utf-8")
    lines = cast("anyio.AsyncFile[str]", LineReader(streams.input, on_end))
    async with anyio.create_task_group() as group:
        group.start_soon(_cancel_on_signal, group.cancel_scope, on_end)
        async with stdio_server(lines, anyio.wrap_file(output)) as (received, sent):
            await server.run(received, sent, server.create_initialization_options())
        group.cancel_scope.cancel()


async def _cancel_on_signal(scope: anyio.CancelScope, on_end: Callable[[], None]) -> None:
    with anyio.open_signal_receiver(*STOP_SIGNALS) as received:
        async for _ in received:
            on_end()
            scope.cancel()
            return
