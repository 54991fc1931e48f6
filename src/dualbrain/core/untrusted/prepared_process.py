"""Processes that have imported what a function needs, and fork one bounded process for each call of it.

The imports of a parser take longer than most files. A prepared process never reads a file itself, so no call can leave
anything behind for the next one. It ends with the process that started it, and after `IDLE_SECONDS` without a call.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import socket
import struct
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from weakref import WeakSet

import msgspec

IDLE_SECONDS = 30.0
"""A prepared process that gets no call for this time ends [s]."""
MAX_IDLE = 2
"""Prepared processes of one function that are kept between calls."""
CHANNEL = 3
"""Number of the socket in the prepared process."""
ORDER, STATUS = struct.Struct("<d"), struct.Struct("<i")
"""The time that a call may still need [s], then its exit code as in `subprocess`."""
_ENVIRONMENT = ("PATH", "HOME", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "TMPDIR", "PYTHONPATH", "PYTHONHOME", "MUJOCO_GL")
_ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"}
_START = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from dualbrain.core.untrusted import bounded_process_child as child; child.main(sys.argv[2])"
)


@dataclass(frozen=True, slots=True)
class Preparation:
    """What a prepared process depends on: its function ("package.module:name"), import folders and environment."""

    function: str
    folders: tuple[str, ...]
    environment: tuple[tuple[str, str], ...]

    @classmethod
    def here(cls, function: str) -> Preparation:
        """The function with the import folders and the environment of this process."""
        folders = tuple(os.path.abspath(folder) for folder in sys.path)  # the process runs in another folder
        return cls(function, folders, tuple(_environment(os.environ).items()))


def _environment(variables: Mapping[str, str]) -> dict[str, str]:
    """The few variables that Python and its libraries need: no keys and no secrets."""
    return {name: variables[name] for name in _ENVIRONMENT if name in variables} | _ONE_THREAD


class PreparedProcess:
    """A process that forks one process for each call, one call at a time."""

    def __init__(self, preparation: Preparation) -> None:
        """Start the process; its imports run while the first call waits."""
        _started.add(self)
        self.preparation = preparation
        self._channel, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        flags = ["-S"] if sys.flags.no_site else []  # so that the process finds the same packages
        folders = msgspec.json.encode(preparation.folders).decode()
        with other, open(os.devnull, "r+b", buffering=0) as null:
            actions = [(os.POSIX_SPAWN_DUP2, null.fileno(), number) for number in range(3)]
            self._pid = os.posix_spawn(
                sys.executable,
                [sys.executable, "-P", *flags, "-c", _START, folders, preparation.function],
                dict(preparation.environment),
                file_actions=[*actions, (os.POSIX_SPAWN_DUP2, other.fileno(), CHANNEL)],
                setsid=True,
            )

    def begin(self, source: int, target: int) -> bool:
        """Start a call that reads the file `source` and writes to the pipe `target`; False if the process has ended."""
        try:
            socket.send_fds(self._channel, [b"call"], [source, target])
        except OSError:
            return False
        return True

    def end_call(self, seconds: float) -> int | None:
        """The exit code of the call; None if the prepared process itself has ended.

        A call that runs for longer than `seconds` is killed, which counts as the end of its processor time (SIGXCPU).
        """
        try:
            self._channel.send(ORDER.pack(seconds))
            status = self._channel.recv(STATUS.size)
        except OSError:
            return None
        return STATUS.unpack(status)[0] if status else None

    def disconnect(self) -> None:
        """Close this side of the channel."""
        self._channel.close()

    def close(self) -> None:
        """Let the process end, and collect it."""
        self.disconnect()
        with contextlib.suppress(ChildProcessError):
            os.waitpid(self._pid, 0)


@dataclass(slots=True)
class BoundedCall:
    """One call in a process of its own: `output` is the pipe that it writes to."""

    process: PreparedProcess
    output: int
    _status: int | None = field(default=None, init=False)
    _ended: bool = field(default=False, init=False)

    def exit_code(self, seconds: float) -> int | None:
        """The exit code as in `subprocess`; a call that runs for longer than `seconds` is killed."""
        if not self._ended:
            self._status, self._ended = self.process.end_call(seconds), True
        return self._status

    def end(self) -> None:
        """Kill the call if it still runs, and keep the prepared process for the next one."""
        os.close(self.output)
        if self.exit_code(0.0) is None:
            self.process.close()
        else:
            _keep(self.process)


_idle: dict[Preparation, list[PreparedProcess]] = {}
_started: WeakSet[PreparedProcess] = WeakSet()


def _disconnect_all() -> None:
    """A prepared process serves only the process that started it, and ends with it."""
    for process in _started:
        process.disconnect()
    _started.clear()
    _idle.clear()


os.register_at_fork(after_in_child=_disconnect_all)
atexit.register(_disconnect_all)


def begin_call(function: str, content: bytes) -> BoundedCall:
    """Start a call of the `function` ("package.module:name"), whose process reads `content`."""
    preparation = Preparation.here(function)
    with os.fdopen(os.memfd_create("argument"), "r+b") as source:
        source.write(content)
        source.seek(0)
        output, target = os.pipe()
        try:
            process = _take(preparation)
            while not process.begin(source.fileno(), target):  # it ended for want of calls
                process.close()
                process = _take(preparation)
        finally:
            os.close(target)
    return BoundedCall(process, output)


def _take(preparation: Preparation) -> PreparedProcess:
    try:
        return _idle[preparation].pop()
    except LookupError:
        return PreparedProcess(preparation)


def _keep(process: PreparedProcess) -> None:
    idle = _idle.setdefault(process.preparation, [])
    if len(idle) < MAX_IDLE:
        idle.append(process)
    else:
        process.close()


def kill_group(pid: int) -> None:
    """Kill a process and all that it started."""
    try:
        os.killpg(pid, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
