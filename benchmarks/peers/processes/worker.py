"""Worker process of a filter: answers each JSON line of its input with a JSON line, until the input ends.

`filter_process.py` starts it as `python -m benchmarks.peers.processes.worker MODULE` in the environment of the filter;
it requires numpy and the requirements of MODULE.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import time
from importlib import metadata
from types import ModuleType
from typing import Any

import numpy as np

from benchmarks.peers.problems.adversary import closed_loop
from benchmarks.peers.problems.problem import load

clock = time.perf_counter_ns


class Worker:
    """The filter of a module, on the problem of the last `prepare` request."""

    def __init__(self, module: ModuleType) -> None:
        self.module = module
        self.problem, self.filter = None, None
        self.states, self.nominals = np.empty((0, 0)), np.empty((0, 0))

    def versions(self, _: dict[str, Any]) -> dict[str, Any]:
        """Return the versions of Python and of the installed packages that the module lists."""
        found = {}
        for name in self.module.VERSIONS:
            try:
                found[name] = metadata.version(name)
            except metadata.PackageNotFoundError:
                continue
        return {"versions": found | {"python": sys.version.split()[0]}}

    def prepare(self, request: dict[str, Any]) -> dict[str, Any]:
        """Build the filter for a new problem and take its first step; returns both times [s]."""
        self.problem = load(request["problem"])
        if "states" in request:
            with np.load(request["states"]) as data:
                self.states, self.nominals = data["states"], data["nominals"]
        start, processor_start = clock(), time.process_time()
        self.filter = self.module.Filter(self.problem, **request["options"])
        built = clock()
        error = None
        if len(self.states):
            error = self._try_step(self.states[0], self.nominals[0])[1]
        times = {"prepare_s": 1e-9 * (built - start), "first_s": 1e-9 * (clock() - built)}
        return times | {"processor_s": time.process_time() - processor_start, "error": error}

    def block(self, request: dict[str, Any]) -> dict[str, Any]:
        """Return the times of steps start..stop and their mean processor time [ns], after `warm` untimed steps."""
        start, stop = request["start"], request["stop"]
        failed = sum(
            self._try_step(self.states[k], self.nominals[k])[1] is not None
            for k in range(max(0, start - request["warm"]), start)
        )
        time_block, processor_start = getattr(self.filter, "block", None), time.process_time_ns()
        times = time_block(self.states[start:stop], self.nominals[start:stop], clock) if time_block else None
        if times is None:
            times, failed = self._timed_steps(start, stop)
        return {
            "ns": times,
            "failed": failed,
            "processor_ns": (time.process_time_ns() - processor_start) / (stop - start),
        }

    def _timed_steps(self, start: int, stop: int) -> tuple[list[int], int]:
        times, failed, step = [], 0, self.filter.step
        for q, u_nom in zip(self.states[start:stop], self.nominals[start:stop], strict=True):
            start_ns = clock()
            try:
                step(q, u_nom)
            except Exception:  # counted; its time is the time until the exception
                failed += 1
            times.append(clock() - start_ns)
        return times, failed

    def answers(self, request: dict[str, Any]) -> dict[str, Any]:
        """Return the controls at the states `at`, and the QP rows if the filter states them."""
        self.filter.reset()
        found = []
        for k in request["at"]:
            u, error = self._try_step(self.states[k], self.nominals[k])
            one = {"u": _to_list(u), "error": error}
            if hasattr(self.filter, "stated_rows"):
                one["stated"] = [array.tolist() for array in self.filter.stated_rows()]
            found.append(one)
        return {"answers": found, "margin": self.filter.margin, "evaluated": self.filter.step_statistics()}

    def once(self, request: dict[str, Any]) -> dict[str, Any]:
        """Return the control and the reported status of one step at any state; numbers may be NaN."""
        self.filter.reset()
        u, error = self._try_step(np.array(request["q"], float), np.array(request["u_nom"], float))
        return {"u": _to_list(u), "error": error, "flag": self.filter.reported_status() if error is None else None}

    def loop(self, request: dict[str, Any]) -> dict[str, Any]:
        """Run the adversarial closed loop with acceleration limits."""
        self.filter.reset()
        return closed_loop(
            self.problem, self.filter.step, self.filter.reported_status, steps=request["steps"], seed=request["seed"]
        )

    def _try_step(self, q: np.ndarray, u_nom: np.ndarray) -> tuple[np.ndarray | None, str | None]:
        try:
            return np.asarray(self.filter.step(q, u_nom), float), None
        except Exception as error:  # an exception of the filter is its answer
            return None, type(error).__name__


def _to_list(u: np.ndarray | None) -> list[float] | None:
    return None if u is None else u.tolist()


def main() -> None:
    """Answer requests until the input ends; output of libraries goes to stderr."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    start = clock()
    try:
        worker = Worker(importlib.import_module(sys.argv[1]))
    except ImportError as error:
        print(json.dumps({"refused": f"{type(error).__name__}: {error}"}), file=answers, flush=True)
        return
    print(json.dumps({"import_s": 1e-9 * (clock() - start)}), file=answers, flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        try:
            answer = getattr(worker, request["do"])(request)
        except Exception as error:  # reported to the parent, which continues without this filter
            answer = {"refused": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
