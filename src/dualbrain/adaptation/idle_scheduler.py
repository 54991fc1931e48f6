"""Scheduling of training in idle time: while the robot rests, the machine has little load and runs on mains power.

The checks take no lock and open no socket, so they cannot disturb a robot that starts at the same moment.
"""

from __future__ import annotations

import ctypes
import math
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
"""Limits of the load per processor: training starts below the first and continues while other processes stay below the
second."""


@dataclass(frozen=True, slots=True)
class MachineLoad:
    """The load of the machine.

    `load` is the number of running or waiting processes (mean of a minute), `processors` the number of processors.
    """

    load: float
    processors: int
    on_battery: bool


def read_machine_load(power: Path = POWER_SUPPLY) -> MachineLoad:
    """The present load; a machine without visible batteries is not on battery.

    Batteries of other devices (mouse, keyboard, headset), whose `scope` is "Device", do not count.
    """
    supplies = list(power.iterdir()) if power.is_dir() else []
    own_supplies = (one for one in supplies if _attribute(one, "scope") != "Device")
    on_battery = any(_attribute(one, "status") == "Discharging" for one in own_supplies)
    return MachineLoad(os.getloadavg()[0], os.cpu_count() or 1, on_battery)


def _attribute(supply: Path, name: str) -> str:
    """One attribute of a power supply; "" if it has none, or if the supply is just being removed."""
    try:
        return (supply / name).read_text("utf-8", "replace").strip()
    except OSError:
        return ""


def robot_activity(
    ledger: Path, sockets: Sequence[Path], *, running: Sequence[Path] = (), own_pid: int | None = None
) -> str:
    """Why the robot counts as active, "" if it is idle; the process `own_pid` is ignored.

    A session holds the writer lock of its ledger from before the first motion until all is recorded; a gatekeeper
    listens at its socket as long as it controls a robot. The gatekeepers at `running` are known to run, so they count
    without a look at their sockets, which may be bound by a relative path.
    """
    holder = current_holder(ledger)
    if holder is not None and holder.pid != own_pid:
        return f"{holder.name} (process {holder.pid})"
    bound = _bound_sockets()
    active = (*running, *(path for path in sockets if str(path.absolute()) in bound))
    return f"a gatekeeper at {active[0]}" if active else ""


def _bound_sockets() -> frozenset[str]:
    """The paths to which the sockets of this machine are bound: the eighth column of `PROC_NET_UNIX`, with spaces."""
    if not PROC_NET_UNIX.is_file():
        return frozenset()
    rows = (line.split(maxsplit=7) for line in os.fsdecode(PROC_NET_UNIX.read_bytes()).splitlines())
    return frozenset(row[7] for row in rows if len(row) == 8)


LOAD_AVERAGING_TIME = 60.0
"""Time constant of the averaged load [s]."""


def remaining_load(threads: int, halted_time: float) -> float:
    """The part of the averaged load that training in `threads` threads causes, `halted_time` [s] after its pause began.

    The load of a paused process decays with `LOAD_AVERAGING_TIME`, so that it soon hides no other process.
    """
    return threads * math.exp(-halted_time / LOAD_AVERAGING_TIME)


def blocking_reason(machine: MachineLoad, activity: str, *, own_load: float = 0.0) -> str:
    """Why training must wait now, "" if it may run; `own_load` is the load that the training itself causes.

    `own_load` = 0 means that training has not started, and applies the stricter limit.
    """
    if activity:
        return activity
    if machine.on_battery:
        return "the machine runs on battery"
    others = max(machine.load - own_load, 0.0) / machine.processors
    if others > (MAX_LOAD_TO_CONTINUE if own_load else MAX_LOAD_TO_START):
        return f"the machine is busy (load {machine.load:.1f} on {machine.processors} processors)"
    return ""


PR_SET_PDEATHSIG = 1
"""The `prctl` option of Linux that requests a signal when the parent process ends."""


@dataclass(frozen=True, slots=True)
class IdleSchedulerConfig:
    """Timing of the scheduler.

    `poll_period` [s] is the period of the checks, `quiet_time` [s] the idle time before work starts or resumes, and
    `max_halted_time` [s] the longest pause before the work is stopped.
    """

    poll_period: float = 0.2
    quiet_time: float = 5.0
    max_halted_time: float = 120.0


class IdleScheduler:
    """Runs one command in idle time.

    `get_blocking_reason` receives the pid of the process (None if there is none) and returns why it must wait; `report`
    receives every change of status.
    """

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
        """Use `start` to start or resume the work, as leader of a process group and with `kill_on_parent_exit`."""
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

    @property
    def halted_time(self) -> float:
        """Time since the work was paused [s]; 0 if it is not paused."""
        return 0.0 if self._halted_at is None else self._clock() - self._halted_at

    def run(self) -> int:
        """Run until the work has ended by itself and return its exit code.

        An exception, such as an interrupt, ends the work.
        """
        try:
            while (code := self._exit_code()) is None:
                self._step(self._get_blocking_reason(self._child.pid if self._child else None))
                self._sleep(self._config.poll_period)
        finally:
            self._kill()
        return code

    def _step(self, reason: str) -> None:
        """One check: start, pause, resume or stop the work."""
        now = self._clock()
        self._quiet_since = None if reason else now if self._quiet_since is None else self._quiet_since
        is_quiet = self._quiet_since is not None and now - self._quiet_since >= self._config.quiet_time
        if self._child is None:
            if is_quiet:
                self._child = self._start()
                self._report_status("training")
            elif reason:
                self._report_status(f"waiting: {reason}")
        elif self._halted_at is None:
            if reason:
                self._signal(signal.SIGSTOP)
                self._halted_at = now
                self._report_status(f"paused: {reason}")
        elif is_quiet:
            self._signal(signal.SIGCONT)
            self._halted_at = None
            self._report_status("training")
        elif now - self._halted_at > self._config.max_halted_time:
            self._kill()
            self._report_status("stopped for now; training resumes from the last checkpoint")

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

    def _report_status(self, status: str) -> None:
        if status != self._last_status:
            self._report(status)
            self._last_status = status


def kill_on_parent_exit(parent: int) -> Callable[[], None]:
    """A `preexec_fn` for `Popen`: from its first instruction on, the process is killed when `parent` ends.

    It is killed however `parent` ends, even while it is stopped. The main thread of `parent` must start it. Raises
    `OSError` in the child if the kernel refuses.
    """
    prctl = ctypes.CDLL(None, use_errno=True).prctl

    def bind() -> None:
        if prctl(PR_SET_PDEATHSIG, signal.SIGKILL) != 0:
            raise OSError(ctypes.get_errno(), "prctl")
        if os.getppid() != parent:  # it ended before the request
            os.kill(os.getpid(), signal.SIGKILL)

    return bind
