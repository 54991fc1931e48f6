"""Work that runs only while nothing speaks against it, in a process that is halted at once when something does.

Halting (SIGSTOP) takes effect within one look, wherever the work is: the processor is free for the robot before the
next step is over. Work that has been halted for long is killed, which frees its memory too, and begun again later: it
must go on where it was, as a fit does. It never outlives who watches it (`bound_to`): nobody would halt it any more.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

PR_SET_PDEATHSIG = 1
"""What Linux calls the wish to be sent a signal when one's parent ends."""


@dataclass(frozen=True, slots=True)
class Pace:
    """How often to look [s], how long it must be quiet before work goes on [s], how long it may stay halted [s]."""

    look: float = 0.2
    calm: float = 5.0
    halted: float = 120.0


class LowLoad:
    """Runs one command in its gaps. `why_not` is told the process (None: there is none) and says what is against it."""

    def __init__(
        self, start: Callable[[], subprocess.Popen[bytes]], why_not: Callable[[int | None], str],
        tell: Callable[[str], None], *, clock: Callable[[], float], sleep: Callable[[float], None],
        pace: Pace | None = None,
    ) -> None:  # fmt: skip
        """`start` begins the work, or goes on with it, as the leader of a process group and `bound_to` this one."""
        self._start, self._why_not, self._tell, self._clock, self._sleep = start, why_not, tell, clock, sleep
        self._pace = pace or Pace()
        self._child: subprocess.Popen[bytes] | None = None
        self._halted_at: float | None = None
        self._quiet_since: float | None = None
        self._said = ""

    def run(self) -> int:
        """The exit code of the work, once it has ended by itself; an interruption of this ends it."""
        try:
            while (code := self._ended()) is None:
                self._turn(self._why_not(self._child.pid if self._child else None))
                self._sleep(self._pace.look)
        finally:
            self._kill()
        return code

    def _turn(self, reason: str) -> None:
        """One look: begin, halt, go on or give up for now."""
        now = self._clock()
        self._quiet_since = None if reason else now if self._quiet_since is None else self._quiet_since
        calm = self._quiet_since is not None and now - self._quiet_since >= self._pace.calm
        if self._child is None:
            if calm:
                self._child = self._start()
                self._say("learning")
            elif reason:
                self._say(f"waiting: {reason}")
        elif self._halted_at is None:
            if reason:
                self._signal(signal.SIGSTOP)
                self._halted_at = now
                self._say(f"halted: {reason}")
        elif calm:
            self._signal(signal.SIGCONT)
            self._halted_at = None
            self._say("learning")
        elif now - self._halted_at > self._pace.halted:
            self._kill()
            self._say("put away for now; what was learnt up to the last checkpoint is kept")

    def _ended(self) -> int | None:
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

    def _say(self, words: str) -> None:
        if words != self._said:
            self._tell(words)
            self._said = words


def bound_to(parent: int) -> Callable[[], None]:
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
