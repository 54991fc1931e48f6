"""Worker pools: carry out units of work in this process, or in several processes of this machine.

A worker process ends with its parent, also in the middle of a unit and however the parent ends. A worker that dies, or
that is killed because it reported nothing for too long, costs only the unit that it held; the next start continues with
that unit. The evaluation and the experiments share these pools.
"""

from __future__ import annotations

import os
import signal
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait
from typing import Any, Generic, Protocol, TypeVar

import msgspec


class Unit(Protocol):
    """A piece of work with a unique key."""

    @property
    def key(self) -> str:
        """The key of the unit in its log."""
        ...


U = TypeVar("U", bound=Unit)
UnitRunner = Callable[[U], Iterator[dict[str, Any]]]
"""Carries out one unit and yields its log lines."""
WorkerHandle = tuple[Any, Any]
"""The pool's end of a worker's pipe, and the worker's process."""
WORKER_TIMEOUT_S = 3600.0
"""A worker that reports nothing for this long is killed [s]; a batch of planner requests reports only at its end."""
POLL_INTERVAL_S = 1.0
"""Interval between two checks for workers that reported nothing for too long [s]."""
NICENESS = 5
"""Default niceness of worker processes."""
MAX_ERROR_CHARS, MAX_TRACEBACK_CHARS = 400, 2000


class UnitReport(msgspec.Struct, Generic[U], frozen=True):
    """A report on `unit`: a log `line`, or without one the end of the unit, with an `error` if it failed.

    `error` is the exception in one line, `traceback` the end of its traceback.
    """

    unit: U
    line: dict[str, Any] | None = None
    error: str = ""
    traceback: str = ""


class WorkerPool(Protocol[U]):
    """Anything that can carry out units, on this machine or on others."""

    def run_units(self, units: Iterable[U]) -> Iterator[UnitReport[U]]:
        """Reports as they arrive: the lines of one unit in their order, those of different units interleaved."""
        ...


@dataclass(slots=True)
class BusyWorker(Generic[U]):
    """A worker that holds a unit: its process, the unit, and the time of its last report [s]."""

    process: Any
    unit: U
    last_report_time: float


class SerialPool(Generic[U]):
    """Runs units in this process, one after another."""

    def __init__(self, run_unit: UnitRunner[U]) -> None:
        """`run_unit` carries out one unit."""
        self._run_unit = run_unit

    def run_units(self, units: Iterable[U]) -> Iterator[UnitReport[U]]:
        """Reports unit by unit."""
        for unit in units:
            yield from report_unit(self._run_unit, unit)


class ProcessPool(Generic[U]):
    """Runs units in `jobs` processes; a process receives its next unit as soon as it is idle."""

    def __init__(
        self,
        make_runner: Callable[[], UnitRunner[U]],
        jobs: int,
        *,
        niceness: int = NICENESS,
        timeout_s: float = WORKER_TIMEOUT_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Processes are started when there is work for them.

        `make_runner` is pickled and called once in each worker. Workers run at `niceness`; one that reports nothing for
        `timeout_s` [s], measured by `clock` [s], is killed.
        """
        self._make_runner, self._jobs, self._niceness = make_runner, jobs, niceness
        self._timeout_s, self._clock, self._context = timeout_s, clock, get_context("spawn")

    def run_units(self, units: Iterable[U]) -> Iterator[UnitReport[U]]:
        """Reports of all workers, as they arrive."""
        left = iter(units)
        busy: dict[Any, BusyWorker[U]] = {}  # by pipe
        try:
            for unit in (unit for _ in range(self._jobs) for unit in [next(left, None)] if unit):
                self._assign_unit(busy, self._start_worker(), unit)
            while busy:
                for pipe in wait(list(busy), POLL_INTERVAL_S):
                    yield from self._receive(busy, pipe, left)
                self._kill_hung_workers(busy)
        finally:
            for worker in busy.values():
                worker.process.terminate()

    def _receive(self, busy: dict[Any, BusyWorker[U]], pipe: Any, left: Iterator[U]) -> Iterator[UnitReport[U]]:
        """Receive one report; at the end of a unit its worker gets the next one."""
        worker = busy[pipe]
        handle: WorkerHandle | None = (pipe, worker.process)
        try:
            report: UnitReport[U] = pipe.recv()
            worker.last_report_time = self._clock()
        except (EOFError, OSError):  # the worker died, perhaps in the middle of a report
            worker.process.join()
            report = UnitReport(worker.unit, error=self._exit_message(worker))
            pipe.close()
            handle = None
        if report.line is None:
            del busy[pipe]
            following = next(left, None)
            if following:
                self._assign_unit(busy, handle or self._start_worker(), following)
            elif handle:
                pipe.close()
        yield report

    def _kill_hung_workers(self, busy: dict[Any, BusyWorker[U]]) -> None:
        """Kill workers that reported nothing for too long; their closed pipes then report their death."""
        for worker in busy.values():
            if self._is_hung(worker):
                worker.process.kill()

    def _exit_message(self, worker: BusyWorker[U]) -> str:
        why = f", killed after it had reported nothing for {self._timeout_s:.0f} s" if self._is_hung(worker) else ""
        return f"the worker died with exit code {worker.process.exitcode}{why}"

    def _is_hung(self, worker: BusyWorker[U]) -> bool:
        return self._clock() - worker.last_report_time >= self._timeout_s

    def _start_worker(self) -> WorkerHandle:
        ours, theirs = self._context.Pipe()
        arguments = (theirs, self._make_runner, self._niceness)
        process = self._context.Process(target=_worker_main, args=arguments, daemon=False)
        process.start()
        theirs.close()
        return ours, process

    def _assign_unit(self, busy: dict[Any, BusyWorker[U]], handle: WorkerHandle, unit: U) -> None:
        pipe, process = handle
        try:
            pipe.send(unit)
        except OSError:  # the worker died after the end of its last unit
            pipe.close()
            process.terminate()
            self._assign_unit(busy, self._start_worker(), unit)
        else:
            busy[pipe] = BusyWorker(process, unit, self._clock())


def report_unit(run_unit: UnitRunner[U], unit: U) -> Iterator[UnitReport[U]]:
    """The lines of a unit and its end; an exception is reported and ends this unit only."""
    try:
        for line in run_unit(unit):
            yield UnitReport(unit, line)
    except Exception as error:
        text = f"{type(error).__name__}: {error}"[:MAX_ERROR_CHARS]
        yield UnitReport(unit, error=text, traceback=traceback.format_exc().strip()[-MAX_TRACEBACK_CHARS:])
        return
    yield UnitReport(unit)


def _worker_main(pipe: Any, make_runner: Callable[[], UnitRunner[Any]], niceness: int) -> None:
    """Main loop of a worker process: receive a unit, report on it, until the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent, which terminates its workers
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.nice(niceness)
    run_unit = make_runner()
    while True:
        try:
            unit: Any = pipe.recv()
            for report in report_unit(run_unit, unit):
                pipe.send(report)
        except (EOFError, BrokenPipeError):
            return


def _end_with_parent() -> None:
    """Wait for the end of the parent, and end this process."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
