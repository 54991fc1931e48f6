"""Workers: processes that carry out units one after another, each handed to whoever is free.

A worker ends when its pipe closes, so none outlives the parent by more than the unit under way; a worker that dies
costs its unit only.
"""

from __future__ import annotations

import os
import signal
import time
import traceback
from collections.abc import Iterable, Iterator
from functools import partial
from importlib import import_module
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

from experiments.engine.experiment import Experiment, Row, WorkUnit

SPAWN = get_context("spawn")


def run_units(
    name: str, units: Iterable[WorkUnit], jobs: int, niceness: int, catalogue: str = "experiments.engine.catalogue"
) -> Iterator[Row]:
    """The rows of `units` of the proof `name`, as they are done by `jobs` processes; `catalogue` is a module's name."""
    hire = partial(_start_worker, name, niceness, catalogue)
    left = iter(units)
    busy: dict[Connection, tuple[BaseProcess, WorkUnit]] = {}
    try:
        for unit in (unit for _ in range(jobs) for unit in [next(left, None)] if unit):
            _assign_unit(busy, *hire(), unit)
        while busy:
            for pipe in list(wait(list(busy))):
                process, unit = busy.pop(pipe)
                try:
                    yield pipe.recv()
                except EOFError:
                    process.join()
                    yield {"key": unit.key, "error": f"the worker died with exit code {process.exitcode}"}
                    pipe.close()
                    worker = None
                else:
                    worker = pipe, process
                following = next(left, None)
                if following:
                    _assign_unit(busy, *(worker or hire()), following)
                elif worker:
                    pipe.close()
    finally:
        for process, _ in busy.values():
            process.terminate()


def _start_worker(name: str, niceness: int, catalogue: str) -> tuple[Connection, BaseProcess]:
    ours, theirs = SPAWN.Pipe()
    process = SPAWN.GatekeeperProcess(target=_worker_main, args=(theirs, name, niceness, catalogue), daemon=True)
    process.start()
    theirs.close()
    return ours, process


def _assign_unit(busy: dict, pipe: Connection, process: BaseProcess, unit: WorkUnit) -> None:
    busy[pipe] = (process, unit)
    pipe.send(unit)


def _worker_main(pipe: Connection, name: str, niceness: int, catalogue: str) -> None:
    """The life of a worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends its workers
    os.nice(niceness)
    proof: Experiment = import_module(catalogue).EXPERIMENTS[name]
    while True:
        try:
            unit: WorkUnit = pipe.recv()
        except EOFError:
            return
        began = time.monotonic()
        try:
            row = proof.run(unit.parameters)
        except Exception as error:
            row = {"error": f"{type(error).__name__}: {error}"[:400], "traceback": traceback.format_exc()[-2000:]}
        load = round(os.getloadavg()[0], 2)
        try:
            pipe.send({"key": unit.key, **row, "wall_s": round(time.monotonic() - began, 2), "load": load})
        except BrokenPipeError:
            return
