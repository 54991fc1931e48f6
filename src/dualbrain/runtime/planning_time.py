"""How time passes while the planner thinks: the control loop never waits for it.

In lockstep the arm stands still for a fixed simulated time, so that results do not depend on the machine; paced, it
stands still for as long as the planner really takes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass
from threading import Thread
from typing import Protocol, TypeVar

from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.gatekeeper.remote_executor import RemoteExecutor
from dualbrain.records import Attempt

T = TypeVar("T")

PLANNING_TIME = 2.0
"""Simulated seconds that a decision takes in lockstep (design 8)."""


class Clock(Protocol):
    """A monotonic clock [s]."""

    def __call__(self) -> float:
        """Seconds since some fixed moment."""
        ...


@dataclass(frozen=True, slots=True)
class PlanningClock:
    """`measured` False: lockstep. The clock only measures; it steers nothing."""

    clock: Clock
    measured: bool = False
    planning_time: float = PLANNING_TIME

    def wait_for(self, executor: ContractExecutor | RemoteExecutor, ask: Callable[[], T]) -> T | None:
        """The answer of `ask`, called on a thread of its own while the arm stands still; None when a person interrupts.

        Nobody waits for a thread that was left behind by an interruption: it ends with the process.
        """
        answer: Future[T] = Future()
        Thread(target=_set_future, args=(answer, ask), name="planner", daemon=True).start()
        if not self.measured:
            executor.hold(self.planning_time, "planning")
        while not (answer.done() or executor.interrupted()):
            if self.measured:
                executor.hold(0.02, "planning")
            else:
                wait((answer,), timeout=0.1)
        return None if executor.interrupted() else answer.result()

    def measure(self, do: Callable[[], T]) -> tuple[T, float]:
        """The result of `do` and how long it took [s]."""
        start = self.clock()
        return do(), self.clock() - start


def _set_future(answer: Future[T], ask: Callable[[], T]) -> None:
    """Put into `answer` what `ask` returns or raises."""
    try:
        answer.set_result(ask())
    except BaseException as error:  # it is raised where the answer is read
        answer.set_exception(error)


LATENCY_PARTS = {
    "retrieval": "retrieval",
    "planner_load": "load of the model",
    "planner_prefill": "prefill",
    "planner_decode": "decoding",
    "planner_rest": "rest of the planner",
    "gate": "validation",
}
"""The parts of a decision by their keys in the timings of an episode, with their words, in their order."""


def decision_timings(attempts: Sequence[Attempt], retrieval: float) -> dict[str, float]:
    """Times of a decision [s], added up over its shots.

    decision = retrieval + planner + gate; planner = load + prefill + decode + rest, as far as the planner tells them
    (`planner_load`, …); without being told anything, the whole of it is rest. In lockstep no time passes for the robot.
    """
    told = [attempt.proposal.timings for attempt in attempts]
    names = dict.fromkeys(name for one in told for name in one if name != "total" and not name.endswith("_tokens"))
    parts = {f"planner_{name}": sum(one.get(name, 0.0) for one in told) for name in names}
    planner, gate = sum(one.get("total", 0.0) for one in told), sum(attempt.gate_s for attempt in attempts)
    parts["planner_rest"] = max(0.0, planner - sum(parts.values()))
    return {"retrieval": retrieval, "planner": planner, **parts, "gate": gate, "decision": retrieval + planner + gate}


def latency_breakdown(spent: Mapping[str, float]) -> tuple[tuple[str, float], ...]:
    """The parts of a decision in words with their times [s], those that were measured, in their order."""
    return tuple((words, spent[name]) for name, words in LATENCY_PARTS.items() if name in spent)


def format_timings(spent: Mapping[str, float]) -> str:
    """One line for people: "decided in 12.3 s: retrieval 0.04 s, prefill 4.1 s, …"; "" if nothing was decided."""
    parts = ", ".join(f"{words} {_format_seconds(value)}" for words, value in latency_breakdown(spent) if value > 0.0)
    return f"decided in {_format_seconds(spent['decision'])}: {parts}" if parts and "decision" in spent else ""


def _format_seconds(value: float) -> str:
    return f"{value:.2f} s" if value >= 0.1 else f"{value * 1e3:.1f} ms"
