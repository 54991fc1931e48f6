"""A contestant's process: answers one JSON line for each it is sent, and stays alive until its input ends.

Run by `crew.py` as `python -m benchmarks.peers.processes.worker MODULE` in the contestant's environment; needs numpy and what MODULE needs.
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
    """One module's filter on the problem of the day."""

    def __init__(self, module: ModuleType) -> None:
        self.module = module
        self.problem, self.filter = None, None
        self.states, self.nominals = np.empty((0, 0)), np.empty((0, 0))

    def versions(self, _: dict[str, Any]) -> dict[str, Any]:
        """Of what the module names, where installed."""
        found = {}
        for name in self.module.VERSIONS:
            try:
                found[name] = metadata.version(name)
            except metadata.PackageNotFoundError:
                continue
        return {"versions": found | {"python": sys.version.split()[0]}}

    def prepare(self, ask: dict[str, Any]) -> dict[str, Any]:
        """Build the filter on a new problem and take its first step, both timed [s]."""
        self.problem = load(ask["problem"])
        if "states" in ask:
            with np.load(ask["states"]) as data:
                self.states, self.nominals = data["states"], data["nominals"]
        begin, busy = clock(), time.process_time()
        self.filter = self.module.Filter(self.problem, **ask["options"])
        built = clock()
        error = None
        if len(self.states):
            error = self._try_step(self.states[0], self.nominals[0])[1]
        times = {"prepare_s": 1e-9 * (built - begin), "first_s": 1e-9 * (clock() - built)}
        return times | {"processor_s": time.process_time() - busy, "error": error}

    def block(self, ask: dict[str, Any]) -> dict[str, Any]:
        """Times [ns] of steps start..stop and the mean processor time of one, after `warm` steps that are not timed."""
        start, stop = ask["start"], ask["stop"]
        failed = sum(
            self._try_step(self.states[k], self.nominals[k])[1] is not None
            for k in range(max(0, start - ask["warm"]), start)
        )
        special, busy = getattr(self.filter, "block", None), time.process_time_ns()
        times = special(self.states[start:stop], self.nominals[start:stop], clock) if special else None
        if times is None:
            times, failed = self._timed_steps(start, stop)
        return {"ns": times, "failed": failed, "processor_ns": (time.process_time_ns() - busy) / (stop - start)}

    def _timed_steps(self, start: int, stop: int) -> tuple[list[int], int]:
        times, failed, step = [], 0, self.filter.step
        for q, u_nom in zip(self.states[start:stop], self.nominals[start:stop], strict=True):
            begin = clock()
            try:
                step(q, u_nom)
            except Exception:  # counted; the time until it gave up is its time
                failed += 1
            times.append(clock() - begin)
        return times, failed

    def answers(self, ask: dict[str, Any]) -> dict[str, Any]:
        """What it returns at the states `at`, and the rows it worked on where it can tell."""
        self.filter.reset()
        found = []
        for k in ask["at"]:
            u, error = self._try_step(self.states[k], self.nominals[k])
            one = {"u": _to_list(u), "error": error}
            if hasattr(self.filter, "stated"):
                one["stated"] = [array.tolist() for array in self.filter.stated()]
            found.append(one)
        return {"answers": found, "margin": self.filter.margin, "evaluated": self.filter.step_statistics()}

    def once(self, ask: dict[str, Any]) -> dict[str, Any]:
        """One step at any state; numbers may be NaN."""
        self.filter.reset()
        u, error = self._try_step(np.array(ask["q"], float), np.array(ask["u_nom"], float))
        return {"u": _to_list(u), "error": error, "flag": self.filter.flag() if error is None else None}

    def loop(self, ask: dict[str, Any]) -> dict[str, Any]:
        """The adversarial closed loop under acceleration limits."""
        self.filter.reset()
        return closed_loop(self.problem, self.filter.step, self.filter.flag, steps=ask["steps"], seed=ask["seed"])

    def _try_step(self, q: np.ndarray, u_nom: np.ndarray) -> tuple[np.ndarray | None, str | None]:
        try:
            return np.asarray(self.filter.step(q, u_nom), float), None
        except Exception as error:  # what a peer raises is its answer
            return None, type(error).__name__


def _to_list(u: np.ndarray | None) -> list[float] | None:
    return None if u is None else u.tolist()


def main() -> None:
    """Answer until the input ends. Whatever libraries print goes to stderr."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    begin = clock()
    try:
        worker = Worker(importlib.import_module(sys.argv[1]))
    except ImportError as error:
        print(json.dumps({"refused": f"{type(error).__name__}: {error}"}), file=answers, flush=True)
        return
    print(json.dumps({"import_s": 1e-9 * (clock() - begin)}), file=answers, flush=True)
    for line in sys.stdin:
        ask = json.loads(line)
        try:
            answer = getattr(worker, ask["do"])(ask)
        except Exception as error:  # told to the parent, who goes on without this contestant
            answer = {"refused": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
