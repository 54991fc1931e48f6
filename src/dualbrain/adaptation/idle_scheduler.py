"""Whether now is a time to learn: a robot that rests, a machine with little to do, no battery that runs down.

Looking disturbs nobody: no lock is taken and no socket is opened, for a robot that starts at that moment must find both
free.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from dualbrain.memory.ledger.writer_lock import current_holder

PROC_NET_UNIX, POWER_SUPPLY = Path("/proc/net/unix"), Path("/sys/class/power_supply")
MAX_LOAD_TO_START, MAX_LOAD_TO_CONTINUE = 0.5, 0.75
"""Load a processor: below the first, learning begins; what others add must stay below the second while it goes on."""


@dataclass(frozen=True, slots=True)
class MachineLoad:
    """How busy it is: `load` (processes that run or wait, mean of a minute), `processors`, running `on_battery`."""

    load: float
    processors: int
    on_battery: bool


def read_machine_load(power: Path = POWER_SUPPLY) -> MachineLoad:
    """The machine as it is now; one without batteries in sight is not on battery."""
    states = [path.read_text().strip() for path in power.glob("*/status")] if power.is_dir() else []
    return MachineLoad(os.getloadavg()[0], os.cpu_count() or 1, "Discharging" in states)


def robot_activity(ledger: Path, sockets: Sequence[Path], *, own_pid: int | None = None) -> str:
    """Why the robot counts as working, "" if it rests; `own` is a process that does not count.

    A session holds its ledger's writer lock from before it moves until all is recorded; a gatekeeper listens at its
    socket as long as it holds a robot.
    """
    holder = current_holder(ledger)
    if holder is not None and holder.pid != own_pid:
        return f"{holder.name} (process {holder.pid})"
    listening = PROC_NET_UNIX.read_text("utf-8", "replace").split() if PROC_NET_UNIX.is_file() else []
    return next((f"a gatekeeper at {path}" for path in sockets if str(path.absolute()) in listening), "")


def blocking_reason(machine: MachineLoad, activity: str, *, own_threads: int = 0) -> str:
    """What speaks against learning now, "" if nothing does; `own_threads` of the load are learning's own.

    0 threads: it has not begun, and wants a quiet machine.
    """
    if activity:
        return activity
    if machine.on_battery:
        return "the battery runs down"
    others = max(machine.load - own_threads, 0.0) / machine.processors
    if others > (MAX_LOAD_TO_CONTINUE if own_threads else MAX_LOAD_TO_START):
        return f"the machine is busy (load {machine.load:.1f} on {machine.processors} processors)"
    return ""


PR_SET_PDEATHSIG = 1
"""What Linux calls the wish to be sent a signal when one's parent ends."""


@dataclass(frozen=True, slots=True)
class IdleSchedulerConfig:
    """How often to look [s], how long it must be quiet before work goes on [s], how long it may stay halted [s]."""

    poll_period: float = 0.2
    quiet_time: float = 5.0
    max_halted_time: float = 120.0


class IdleScheduler:
    """Runs one command in its gaps. `why_not` is told the process (None: there is none) and says what is against it."""

    def __init__(
        self,
        start: Callable[[], subprocess.Popen[bytes]],
        get_blocking_reason: Callable[[int | None], str],
        report: Callable[[str], None],
        *,
        clock: Callable[[], float],
        sleep: Callable[[float], None],
        config: IdleSchedulerConfig | None = None,
    ) -> None:
        """`start` begins the work, or goes on with it, as the leader of a process group and `bound_to` this one."""
        self._start, self._get_blocking_reason, self._report, self._clock, self._sleep = (
            start,
            get_blocking_reason,
            report,
            clock,
            sleep,
        )
        self._config = config or IdleSchedulerConfig()
        self._child: subprocess.Popen[bytes] | None = None
        self._halted_at: float | None = None
        self._quiet_since: float | None = None
        self._last_status = ""

    def run(self) -> int:
        """The exit code of the work, once it has ended by itself; an interruption of this ends it."""
        try:
            while (code := self._exit_code()) is None:
                self._step(self._get_blocking_reason(self._child.pid if self._child else None))
                self._sleep(self._config.poll_period)
        finally:
            self._kill()
        return code

    def _step(self, reason: str) -> None:
        """One look: begin, halt, go on or give up for now."""
        now = self._clock()
        self._quiet_since = None if reason else now if self._quiet_since is None else self._quiet_since
        calm = self._quiet_since is not None and now - self._quiet_since >= self._config.quiet_time
        if self._child is None:
            if calm:
                self._child = self._start()
                self._report_status("learning")
            elif reason:
                self._report_status(f"waiting: {reason}")
        elif self._halted_at is None:
            if reason:
                self._signal(signal.SIGSTOP)
                self._halted_at = now
                self._report_status(f"halted: {reason}")
        elif calm:
            self._signal(signal.SIGCONT)
            self._halted_at = None
            self._report_status("learning")
        elif now - self._halted_at > self._config.max_halted_time:
            self._kill()
            self._report_status("put away for now; what was learnt up to the last checkpoint is kept")

    def _exit_code(self) -> int | None:
        return None if self._child is None else self._child.poll()

    def _kill(self) -> None:
        if self._child is not None:
            self._signal(signal.SIGKILL)
            self._child.wait()
        self._child, self._halted_at = None, None

    def _signal(self, number: int) -> None:
        assert self._child is not None
        if self._child.poll() is None:
            with suppress(ProcessLookupError):
                os.killpg(self._child.pid, number)

    def _report_status(self, words: str) -> None:
        if words != self._last_status:
            self._report(words)
            self._last_status = words


def kill_on_parent_exit(parent: int) -> Callable[[], None]:
    """For `Popen(preexec_fn=...)`: from its first instruction on, the process is killed when `parent` is gone.

    However `parent` ended, and also where the process is halted; it must be `parent`'s main thread that starts it.
    """
    prctl = ctypes.CDLL(None, use_errno=True).prctl

    def bind() -> None:
        if prctl(PR_SET_PDEATHSIG, signal.SIGKILL) != 0:
            raise OSError(ctypes.get_errno(), "prctl")
        if os.getppid() != parent:  # it ended before this was said
            os.kill(os.getpid(), signal.SIGKILL)

    return bind
