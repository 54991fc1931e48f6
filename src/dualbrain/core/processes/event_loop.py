"""An event loop whose end waits for no name resolution.

The loop of `asyncio.run` resolves host names in a pool of threads, and waits for these threads when it ends, as the
interpreter does. A name server that does not respond can delay both far beyond the time limit of a request.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Coroutine
from concurrent.futures import Future
from threading import Thread
from typing import Any, TypeVar

T = TypeVar("T")


def run_with_time_limits(main: Coroutine[Any, Any, T]) -> T:
    """As `asyncio.run(main)`; a time limit in `main` also holds while a host name is being resolved."""
    with asyncio.Runner(loop_factory=_ResolvingLoop) as runner:
        return runner.run(main)


class _ResolvingLoop(asyncio.SelectorEventLoop):
    """Resolves each host name in a thread of its own, which ends with the program."""

    async def getaddrinfo(
        self,
        host: bytes | str | None,
        port: bytes | str | int | None,
        *,
        family: int = 0,
        type: int = 0,
        proto: int = 0,
        flags: int = 0,
    ) -> list[Any]:
        """As `socket.getaddrinfo`."""
        found: Future[list[Any]] = Future()
        found.set_running_or_notify_cancel()  # from now on a cancellation leaves the result to the thread
        arguments = (host, port, family, type, proto, flags)
        Thread(target=_resolve, args=(found, *arguments), name="name resolution", daemon=True).start()
        return await asyncio.wrap_future(found)


def _resolve(found: Future[list[Any]], *arguments: Any) -> None:
    try:
        found.set_result(socket.getaddrinfo(*arguments))
    except Exception as error:  # raised where the result is awaited
        found.set_exception(error)
