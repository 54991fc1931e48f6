"""Who carries out units: any crew that keeps one small promise; here, processes of this machine.

A worker ends when its pipe closes, so none outlives its parent by more than the episode or the questions under way; one
that dies, or is silent for too long and is ended for that, costs only the unit that it held, which the next start goes
on with.
"""

from __future__ import annotations

import os
import signal
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import wait
from typing import Any, Protocol

import msgspec

from dualbrain.evaluation.runner.work_units import Unit

Do = Callable[[Unit], Iterator[dict[str, Any]]]
"""Carries out one unit, line by line."""
Worker = tuple[Any, Any]
"""Its end of the pipe, and its process."""
SILENT_S = 3600.0
"""A worker that told nothing for so long hangs [s]; several of the planner's answers come together."""
LOOK_S = 1.0
"""How often that is looked at, where nobody tells anything [s]."""


@dataclass(slots=True)
class Held:
    """What is known of a busy worker: its process, the unit that it has, when it last told something [s]."""

    process: Any
    unit: Unit
    heard: float


Busy = dict[Any, Held]
"""By pipe."""


class Report(msgspec.Struct, frozen=True):
    """What a crew tells: a `line` of `unit`, or with none that the unit is over, perhaps with an `error`."""

    unit: Unit
    line: dict[str, Any] | None = None
    error: str = ""


class Crew(Protocol):
    """Anything that can carry out units, here or on other machines."""

    def carry_out(self, units: Iterable[Unit]) -> Iterator[Report]:
        """Reports as they come: the lines of one unit in their order, those of different units mixed."""
        ...


class Alone:
    """Does everything itself, one unit after another."""

    def __init__(self, do: Do) -> None:
        """`do` carries out a unit."""
        self._do = do

    def carry_out(self, units: Iterable[Unit]) -> Iterator[Report]:
        """Unit by unit."""
        for unit in units:
            yield from _reports(self._do, unit)


class Processes:
    """`jobs` processes, each handed a unit whenever it is free. `make` builds `Do` in the worker; it is pickled."""

    def __init__(
        self, make: Callable[[], Do], jobs: int, *, clock: Callable[[], float] = time.monotonic
    ) -> None:  # fmt: skip
        """Nothing is started before there is work; `clock` [s] tells for how long a worker was silent."""
        self._make, self._jobs, self._clock, self._context = make, jobs, clock, get_context("spawn")

    def carry_out(self, units: Iterable[Unit]) -> Iterator[Report]:
        """Reports of all workers, as they come."""
        left = iter(units)
        busy: Busy = {}
        try:
            for unit in (unit for _ in range(self._jobs) for unit in [next(left, None)] if unit):
                self._hand(busy, self._hire(), unit)
            while busy:
                for pipe in wait(list(busy), LOOK_S):
                    yield from self._hear(busy, pipe, left)
                self._end_silent(busy)
        finally:
            for held in busy.values():
                held.process.terminate()

    def _hear(self, busy: Busy, pipe: Any, left: Iterator[Unit]) -> Iterator[Report]:
        """One report; at the end of a unit the worker gets the next one."""
        held = busy[pipe]
        worker: Worker | None = (pipe, held.process)
        try:
            report: Report = pipe.recv()
            held.heard = self._clock()
        except (EOFError, OSError):  # also in the midst of a report
            held.process.join()
            report = Report(held.unit, error=self._died(held))
            pipe.close()
            worker = None
        if report.line is None:
            del busy[pipe]
            following = next(left, None)
            if following:
                self._hand(busy, worker or self._hire(), following)
            elif worker:
                pipe.close()
        yield report

    def _end_silent(self, busy: Busy) -> None:
        """End the workers that hang; their pipes then tell that they died."""
        for held in busy.values():
            if self._is_silent(held):
                held.process.kill()

    def _died(self, held: Held) -> str:
        why = f", after nothing was heard of it for {SILENT_S:.0f} s" if self._is_silent(held) else ""
        return f"the worker died with exit code {held.process.exitcode}{why}"

    def _is_silent(self, held: Held) -> bool:
        return self._clock() - held.heard >= SILENT_S

    def _hire(self) -> Worker:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=_work, args=(theirs, self._make), daemon=False)
        process.start()
        theirs.close()
        return ours, process

    def _hand(self, busy: Busy, worker: Worker, unit: Unit) -> None:
        pipe, process = worker
        busy[pipe] = Held(process, unit, self._clock())
        pipe.send(unit)


def _reports(do: Do, unit: Unit) -> Iterator[Report]:
    """The lines of a unit and its end; what raises in it is told, and ends this unit only."""
    try:
        for line in do(unit):
            yield Report(unit, line)
    except Exception as error:
        where = traceback.format_exc().strip().splitlines()[-3:]
        yield Report(unit, error=f"{type(error).__name__}: {error}"[:400] + "\n" + "\n".join(where))
        return
    yield Report(unit)


def _work(pipe: Any, make: Callable[[], Do]) -> None:
    """The life of a worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends its workers
    os.nice(5)
    do = make()
    while True:
        try:
            unit: Unit = pipe.recv()
            for report in _reports(do, unit):
                pipe.send(report)
        except (EOFError, BrokenPipeError):
            return
