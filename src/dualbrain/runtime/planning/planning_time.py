"""Time during planning: the control loop never waits for the planner.

In lockstep the arm holds position for a fixed simulated time, so that results do not depend on the machine; in real
time it holds position for as long as the planner takes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from threading import Thread
from typing import Protocol, TypeVar

from dualbrain.control.executor import Executor
from dualbrain.records import Attempt

T = TypeVar("T")

PLANNING_TIME = 2.0
"""Simulated time [s] that a decision takes in lockstep."""


class Clock(Protocol):
    """A monotonic clock [s]."""

    def __call__(self) -> float:
        """Seconds since a fixed moment."""
        ...


@dataclass(frozen=True, slots=True)
class PlanningClock:
    """Runs the planner in parallel with the control loop; with `measured` False (lockstep), `clock` only measures.

    The planner is called while `exclusive` is held, and in real time only if the request was not interrupted before:
    a lock is for a planner that may still answer an interrupted request.
    """

    clock: Clock
    measured: bool = False
    planning_time: float = PLANNING_TIME
    exclusive: AbstractContextManager[object] = field(default_factory=nullcontext[None])

    def wait_for(self, executor: Executor, propose: Callable[[], T]) -> T | None:
        """The result of `propose`, called on a separate thread while the arm holds position.

        None if a person interrupts. After an interruption the thread is not joined; it ends with the process.
        """
        future: Future[T | None] = Future()

        def ask() -> T | None:
            with self.exclusive:
                return None if self.measured and executor.interrupted() else propose()

        Thread(target=_set_future, args=(future, ask), name="planner", daemon=True).start()
        if not self.measured:
            executor.hold(self.planning_time, "planning")
        while not (future.done() or executor.interrupted()):
            if self.measured:
                executor.hold(0.02, "planning")
            else:
                wait((future,), timeout=0.1)
        return None if executor.interrupted() else future.result()

    def measure(self, function: Callable[[], T]) -> tuple[T, float]:
        """The result of `function` and its duration [s]."""
        start = self.clock()
        return function(), self.clock() - start


def _set_future(future: Future[T | None], propose: Callable[[], T | None]) -> None:
    """Set `future` to the result or the exception of `propose`."""
    try:
        future.set_result(propose())
    except BaseException as error:  # raised where the future is read
        future.set_exception(error)


LATENCY_PARTS = {
    "retrieval": "retrieval",
    "planner_load": "load of the model",
    "planner_prefill": "prefill",
    "planner_decode": "decoding",
    "planner_reuse": "search for a contract of this place",
    "planner_rest": "rest of the planner",
    "gate": "validation",
}
"""Labels of the parts of a decision by their keys in the timings of an episode, in order."""


def decision_timings(attempts: Sequence[Attempt], retrieval: float) -> dict[str, float]:
    """Times of a decision [s], summed over its shots.

    decision = retrieval + planner + gate; planner = load + prefill + decode + rest, as far as the planner reports them
    (`planner_load`, …); a planner that reports no parts has only the rest. In lockstep no time passes for the robot.
    """
    reported = [attempt.proposal.timings for attempt in attempts]
    names = dict.fromkeys(name for one in reported for name in one if name != "total" and not name.endswith("_tokens"))
    parts = {f"planner_{name}": sum(one.get(name, 0.0) for one in reported) for name in names}
    planner, gate = sum(one.get("total", 0.0) for one in reported), sum(attempt.gate_s for attempt in attempts)
    parts["planner_rest"] = max(0.0, planner - sum(parts.values()))
    return {"retrieval": retrieval, "planner": planner, **parts, "gate": gate, "decision": retrieval + planner + gate}


def latency_breakdown(spent: Mapping[str, float]) -> tuple[tuple[str, float], ...]:
    """The measured parts of a decision, labelled, with their times [s], in order."""
    return tuple((words, spent[name]) for name, words in LATENCY_PARTS.items() if name in spent)


def format_timings(spent: Mapping[str, float]) -> str:
    """One line such as "decided in 12.3 s: retrieval 0.04 s, prefill 4.1 s, …"; "" without a decision."""
    parts = ", ".join(f"{words} {_format_seconds(value)}" for words, value in latency_breakdown(spent) if value > 0.0)
    return f"decided in {_format_seconds(spent['decision'])}: {parts}" if parts and "decision" in spent else ""


def _format_seconds(value: float) -> str:
    return f"{value:.2f} s" if value >= 0.1 else f"{value * 1e3:.1f} ms"
