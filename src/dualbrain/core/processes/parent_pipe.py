"""Child processes that end with their parent: the parent holds the write end of the child's standard input open.

    python -m dualbrain.core.processes.parent_pipe PARENT_PID MODULE [ARGUMENT ...]

`start_child` starts this command. It waits for the end of the parent in a thread that sleeps in `poll`, which costs
nothing while the parent runs, and calls `MODULE.main(arguments, pipe)`. The end of the parent is the end of the pipe
or, on Linux, of the process itself, so that another process which inherited the write end does not hide it.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from threading import Lock, Thread
from typing import NoReturn

from dualbrain.core.processes.process_end import end_process
from dualbrain.errors import DualbrainError

STDIN = 0
LENGTH_BYTES = 8
"""Bytes of the length in front of the settings."""
DEFAULT_GRACE = 2.5
"""Time [s] after the end of the parent after which the child is ended at once."""
PARENT_ENDED = 75
"""Exit code of a child that was ended because its parent had ended."""


class ParentPipe:
    """The child's end of the pipe; `ended` is whether the parent has ended."""

    def __init__(self, parent: int, descriptor: int = STDIN) -> None:
        """Watch the process `parent` and the pipe `descriptor`; until `on_end` is called, their end ends this process.

        Assumption: `parent` is the process that started this one.
        """
        self.ended = False
        self._descriptor, self._grace = descriptor, 0.0
        self._on_end: Callable[[], None] = _exit
        self._lock = Lock()
        self._poll = select.poll()
        self._poll.register(descriptor, 0)  # no event is requested, so only the end of the pipe is reported
        with suppress(AttributeError, OSError):  # not on this system; the pipe remains
            self._poll.register(os.pidfd_open(parent), select.POLLIN)
        self._is_orphan = os.getppid() != parent
        Thread(target=self._watch, name="parent pipe", daemon=True).start()

    def read_settings(self) -> bytes:
        """The settings that `start_child` sent; ends the process if the parent ended before it sent all of them."""
        length = int.from_bytes(self._read(LENGTH_BYTES), "little")
        return self._read(length)

    def on_end(self, callback: Callable[[], None], *, grace: float = DEFAULT_GRACE) -> None:
        """Call `callback` in another thread when the parent ends, and end this process `grace` [s] later.

        If the parent has ended already, `callback` is called at once.
        """
        with self._lock:
            self._on_end, self._grace = callback, grace
            ended = self.ended
        if ended:
            callback()

    def _read(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            part = os.read(self._descriptor, count - len(data))
            if not part:
                _exit()
            data += part
        return data

    def _watch(self) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())  # signals are for the main thread
        if not self._is_orphan:
            self._poll.poll()
        ended_at = time.monotonic()
        with self._lock:
            self.ended, callback = True, self._on_end
        try:
            callback()
        finally:
            del callback  # what it belongs to may be cleaned up
            while (left := ended_at + self._grace - time.monotonic()) > 0.0:
                time.sleep(left)
            _exit()


def start_child(module: str, settings: bytes, *arguments: str, pass_fds: Sequence[int] = ()) -> subprocess.Popen[bytes]:
    """Start `module` as a child that ends when this process ends or closes `Popen.stdin`.

    `module` has a function `main(arguments, pipe)`, where `pipe` is a `ParentPipe` from which it reads `settings`. The
    child has a session of its own: signals of the terminal reach the parent only.
    """
    flags = ["-S"] if sys.flags.no_site else []
    command = [
        sys.executable,
        *flags,
        "-m",
        "dualbrain.core.processes.parent_pipe",
        str(os.getpid()),
        module,
        *arguments,
    ]
    child = subprocess.Popen(command, stdin=subprocess.PIPE, bufsize=0, pass_fds=pass_fds, start_new_session=True)
    assert child.stdin is not None
    data = len(settings).to_bytes(LENGTH_BYTES, "little") + settings
    with suppress(BrokenPipeError):  # the child has ended, which its exit code reports
        while data:
            data = data[child.stdin.write(data) or 0 :]
    return child


def _exit() -> NoReturn:
    """End the process without clean-up: there is no one left to report to, and other threads may hang."""
    os._exit(PARENT_ENDED)


def main(arguments: list[str]) -> None:
    """Run the module named on the command line, and end this process."""
    parent, module, *rest = arguments
    pipe = ParentPipe(int(parent))
    try:
        import_module(module).main(rest, pipe)
    except DualbrainError as error:
        sys.exit(f"{module}: {error}")
    end_process()


if __name__ == "__main__":
    from dualbrain.core.processes.parent_pipe import main as run

    run(sys.argv[1:])
