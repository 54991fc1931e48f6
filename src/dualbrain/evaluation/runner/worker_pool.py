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

from dualbrain.evaluation.runner.work_units import WorkUnit

UnitRunner = Callable[[WorkUnit], Iterator[dict[str, Any]]]
"""Carries out one unit, line by line."""
WorkerHandle = tuple[Any, Any]
"""Its end of the pipe, and its process."""
WORKER_TIMEOUT_S = 3600.0
"""A worker that told nothing for so long hangs [s]; several of the planner's answers come together."""
POLL_INTERVAL_S = 1.0
"""How often that is looked at, where nobody tells anything [s]."""


@dataclass(slots=True)
class BusyWorker:
    """What is known of a busy worker: its process, the unit that it has, when it last told something [s]."""

    process: Any
    unit: WorkUnit
    last_report_time: float


BusyWorkers = dict[Any, BusyWorker]
"""By pipe."""


class UnitReport(msgspec.Struct, frozen=True):
    """What a crew tells: a `line` of `unit`, or with none that the unit is over, perhaps with an `error`."""

    unit: WorkUnit
    line: dict[str, Any] | None = None
    error: str = ""


class WorkerPool(Protocol):
    """Anything that can carry out units, here or on other machines."""

    def run_units(self, units: Iterable[WorkUnit]) -> Iterator[UnitReport]:
        """Reports as they come: the lines of one unit in their order, those of different units mixed."""
        ...


class SerialPool:
    """Does everything itself, one unit after another."""

    def __init__(self, run_unit: UnitRunner) -> None:
        """`do` carries out a unit."""
        self._run_unit = run_unit

    def run_units(self, units: Iterable[WorkUnit]) -> Iterator[UnitReport]:
        """Unit by unit."""
        for unit in units:
            yield from _report_unit(self._run_unit, unit)


class ProcessPool:
    """`jobs` processes, each handed a unit whenever it is free. `make` builds `Do` in the worker; it is pickled."""

    def __init__(
        self, make_runner: Callable[[], UnitRunner], jobs: int, *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Nothing is started before there is work; `clock` [s] tells for how long a worker was silent."""
        self._make_runner, self._jobs, self._clock, self._context = make_runner, jobs, clock, get_context("spawn")

    def run_units(self, units: Iterable[WorkUnit]) -> Iterator[UnitReport]:
        """Reports of all workers, as they come."""
        left = iter(units)
        busy: BusyWorkers = {}
        try:
            for unit in (unit for _ in range(self._jobs) for unit in [next(left, None)] if unit):
                self._assign_unit(busy, self._start_worker(), unit)
            while busy:
                for pipe in wait(list(busy), POLL_INTERVAL_S):
                    yield from self._receive(busy, pipe, left)
                self._kill_hung_workers(busy)
        finally:
            for held in busy.values():
                held.process.terminate()

    def _receive(self, busy: BusyWorkers, pipe: Any, left: Iterator[WorkUnit]) -> Iterator[UnitReport]:
        """One report; at the end of a unit the worker gets the next one."""
        held = busy[pipe]
        worker: WorkerHandle | None = (pipe, held.process)
        try:
            report: UnitReport = pipe.recv()
            held.last_report_time = self._clock()
        except (EOFError, OSError):  # also in the midst of a report
            held.process.join()
            report = UnitReport(held.unit, error=self._exit_message(held))
            pipe.close()
            worker = None
        if report.line is None:
            del busy[pipe]
            following = next(left, None)
            if following:
                self._assign_unit(busy, worker or self._start_worker(), following)
            elif worker:
                pipe.close()
        yield report

    def _kill_hung_workers(self, busy: BusyWorkers) -> None:
        """End the workers that hang; their pipes then tell that they died."""
        for held in busy.values():
            if self._is_hung(held):
                held.process.kill()

    def _exit_message(self, held: BusyWorker) -> str:
        why = f", after nothing was heard of it for {WORKER_TIMEOUT_S:.0f} s" if self._is_hung(held) else ""
        return f"the worker died with exit code {held.process.exitcode}{why}"

    def _is_hung(self, held: BusyWorker) -> bool:
        return self._clock() - held.last_report_time >= WORKER_TIMEOUT_S

    def _start_worker(self) -> WorkerHandle:
        ours, theirs = self._context.Pipe()
        process = self._context.Process(target=_worker_main, args=(theirs, self._make_runner), daemon=False)
        process.start()
        theirs.close()
        return ours, process

    def _assign_unit(self, busy: BusyWorkers, worker: WorkerHandle, unit: WorkUnit) -> None:
        pipe, process = worker
        busy[pipe] = BusyWorker(process, unit, self._clock())
        pipe.send(unit)


def _report_unit(do: UnitRunner, unit: WorkUnit) -> Iterator[UnitReport]:
    """The lines of a unit and its end; what raises in it is told, and ends this unit only."""
    try:
        for line in do(unit):
            yield UnitReport(unit, line)
    except Exception as error:
        where = traceback.format_exc().strip().splitlines()[-3:]
        yield UnitReport(unit, error=f"{type(error).__name__}: {error}"[:400] + "\n" + "\n".join(where))
        return
    yield UnitReport(unit)


def _worker_main(pipe: Any, make: Callable[[], UnitRunner]) -> None:
    """The life of a worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends its workers
    os.nice(5)
    do = make()
    while True:
        try:
            unit: WorkUnit = pipe.recv()
            for report in _report_unit(do, unit):
                pipe.send(report)
        except (EOFError, BrokenPipeError):
            return
