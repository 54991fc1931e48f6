"""A worker pool on a Ray cluster: each worker is an actor, which may die, or whose node may die.

A dead worker costs only the unit that it held, as in the pools of one machine: the unit continues where its log ends,
in the next round of the stage or at the next start. All nodes share the results folder; only this process writes logs.
"""

from __future__ import annotations

import os
import pickle
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Generic, cast

import msgspec
import ray
from ray.exceptions import RayError

from dualbrain.evaluation.runner.provenance import code_hash
from dualbrain.evaluation.runner.worker_pool import (
    MAX_ERROR_CHARS,
    NICENESS,
    POLL_INTERVAL_S,
    WORKER_TIMEOUT_S,
    U,
    UnitReport,
    UnitRunner,
    report_unit,
)


class BusyActor(msgspec.Struct, Generic[U]):
    """An actor that holds a unit, and the time of its last report [s]."""

    actor: Any
    unit: U
    last_report_time: float


class RayPool(Generic[U]):
    """Runs units in `jobs` actors of the connected cluster; an actor receives its next unit as soon as it is idle."""

    def __init__(
        self,
        make_runner: Callable[[], UnitRunner[U]],
        jobs: int,
        *,
        environment: Mapping[str, str],
        timeout_s: float = WORKER_TIMEOUT_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Actors are started when there is work for them, each with one CPU.

        `make_runner` is pickled and called once in each actor, after `environment` was set there. An actor that reports
        nothing for `timeout_s` [s], measured by `clock` [s], is killed.
        """
        self._packed, self._jobs, self._environment = pickle.dumps(make_runner), jobs, dict(environment)
        self._timeout_s, self._clock = timeout_s, clock
        self._code = code_hash()
        self.lost_workers = 0
        """Number of actors that died in the last `run_units`."""

    def run_units(self, units: Iterable[U]) -> Iterator[UnitReport[U]]:
        """Reports of all actors, as they arrive."""
        left, self.lost_workers = iter(units), 0
        busy: dict[Any, BusyActor[U]] = {}  # by stream of reports
        try:
            for unit in (unit for _ in range(self._jobs) for unit in [next(left, None)] if unit):
                self._assign_unit(busy, self._start_actor(), unit)
            while busy:
                ready, _ = ray.wait(list(busy), num_returns=1, timeout=POLL_INTERVAL_S)
                for stream in ready:
                    yield from self._receive(busy, stream, left)
                self._kill_hung_actors(busy)
        finally:
            for one in busy.values():
                ray.kill(one.actor)

    def _receive(self, busy: dict[Any, BusyActor[U]], stream: Any, left: Iterator[U]) -> Iterator[UnitReport[U]]:
        """Receive one report; at the end of a unit its actor, or a new one for a dead actor, gets the next one."""
        one = busy[stream]
        actor: Any = one.actor
        try:
            report = cast("UnitReport[U]", ray.get(next(stream)))
            one.last_report_time = self._clock()
        except (RayError, StopIteration) as error:
            report = UnitReport(one.unit, error=self._death_message(one, error))
            self.lost_workers += 1
            ray.kill(actor)
            actor = None
        if report.line is None:
            del busy[stream]
            following = next(left, None)
            if following:
                self._assign_unit(busy, actor or self._start_actor(), following)
            elif actor:
                ray.kill(actor)
        yield report

    def _death_message(self, one: BusyActor[U], error: Exception) -> str:
        if self._is_hung(one):
            return f"the worker was killed after it had reported nothing for {self._timeout_s:.0f} s"
        lines = [line.strip() for line in str(error).splitlines() if line.strip()] or ["no reason given"]
        return f"the worker died: {type(error).__name__}: {lines[-1]}"[:MAX_ERROR_CHARS]

    def _kill_hung_actors(self, busy: dict[Any, BusyActor[U]]) -> None:
        """Kill actors that reported nothing for too long; their streams then report their death."""
        for one in busy.values():
            if self._is_hung(one):
                ray.kill(one.actor)

    def _is_hung(self, one: BusyActor[U]) -> bool:
        return self._clock() - one.last_report_time >= self._timeout_s

    def _start_actor(self) -> Any:
        return _Actor.remote(self._packed, self._environment, self._code)

    def _assign_unit(self, busy: dict[Any, BusyActor[U]], actor: Any, unit: U) -> None:
        stream = actor.run_unit.options(num_returns="streaming").remote(unit)
        busy[stream] = BusyActor(actor, unit, self._clock())


class ActorWorker:
    """One worker process of the cluster."""

    def __init__(self, packed: bytes, environment: Mapping[str, str], code: str) -> None:
        """Make the runner of `packed` with `environment` set; raises `RuntimeError` on a node with other code."""
        if code != (here := code_hash()):
            raise RuntimeError(f"this node has another code of dualbrain: {here} instead of {code}")
        os.environ.update(environment)  # before the runner imports MuJoCo
        os.nice(NICENESS)
        self._run_unit: UnitRunner[Any] = pickle.loads(packed)()

    def run_unit(self, unit: Any) -> Iterator[UnitReport[Any]]:
        """The reports on `unit`, each as soon as it is known."""
        yield from report_unit(self._run_unit, unit)


_Actor: Any = ray.remote(num_cpus=1, max_restarts=0, max_task_retries=0)(ActorWorker)
