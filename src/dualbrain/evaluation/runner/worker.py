"""How one unit is carried out: its episodes in order, each a line for the journal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.evaluation.episodes.case_runner import Clock, Flight, Means, fly
from dualbrain.evaluation.episodes.episode_cache import FlownOnce
from dualbrain.evaluation.episodes.intervention_time import seconds_lost
from dualbrain.evaluation.episodes.scoring import Place, account
from dualbrain.evaluation.planners.answer_cache import KeepingPlanner, Plans, refuse_accident
from dualbrain.evaluation.planners.factory import DRAWN, Planners, Sources, planner_name
from dualbrain.evaluation.protocol.case import Case, Catalogue, case_of
from dualbrain.evaluation.protocol.method import Method, find_method
from dualbrain.evaluation.protocol.suite import Suite, is_due
from dualbrain.evaluation.results.episode_row import Row
from dualbrain.evaluation.runner.run_ledgers import RunFolder, memory_at, plain, rule, when
from dualbrain.evaluation.runner.work_units import Unit
from dualbrain.grounding.vocabulary import vocabulary
from dualbrain.memory.embedding.text_encoder import Encoder, MiniLmEncoder
from dualbrain.memory.memory import Memory
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal
from dualbrain.runtime.counterfactual import Counterfactuals

TOGETHER = 16
"""Questions of the plan pass between two lines of its journal: what is asked side by side, and lost by a kill."""
PLANS, RUNS, STARTS, ONCE = "plans", "runs", "start", "once"


@dataclass(frozen=True)
class Workplace:
    """What every worker is given: suite, folders, ε, the clock that only measures."""

    suite: Suite
    out: Path
    sources: Sources
    clock: Clock
    epsilon: dict[str, float]
    """ε by robot."""
    catalogue: Catalogue = case_of

    def make(self) -> Work:
        """A worker's own `Work`."""
        return Work(self)


class Work:
    """Carries out units; called with one, it yields the lines of the episodes that are not done yet."""

    def __init__(self, place: Workplace) -> None:
        """Planners and encoder are opened when they are first needed."""
        self._at, self._suite = place, place.suite
        self._planners = Planners(place.suite, place.sources, Plans(place.out / PLANS))
        self._once = FlownOnce(place.out / ONCE)

    @cached_property
    def _encoder(self) -> Encoder:
        return MiniLmEncoder.fetched(self._at.sources.cache)

    def __call__(self, unit: Unit) -> Iterator[dict[str, Any]]:
        """The lines of `unit` from its episode number `done` on."""
        method = find_method(unit.method)
        if unit.stage == "plan":
            yield from self._plan(unit, method)
            return
        for order, (seed, repetition) in enumerate(unit.order):
            if order < unit.done:
                continue
            case = self._at.catalogue(unit.task, seed, unit.robot, repetition)
            if unit.stage == "start" or method.remembers:
                yield self._with_ledger(unit, method, case, order)
            else:
                place = Place(unit.row_key(order), self._suite.name, unit.cluster, order, asked=False)
                row = self._flown_once(case, method, place) if unit.stage == "fly" else self._flown(case, method, place)
                yield _line(row)
        if unit.stage == "start" or method.remembers:
            self._folder(unit).tidy(unit.count)

    def close(self) -> None:
        """Let go of the planners."""
        self._planners.close()

    # --- one episode ----------------------------------------------------------------------------------------------

    def _flown_once(self, case: Case, method: Method, place: Place) -> Row:
        """The episode of a method without memory, unless it was flown behind another door."""
        id = self._planners.of(method, case.robot).name
        known = self._once.find(case, method, id, place.key)
        if known is not None:
            return known
        row = self._flown(case, method, place, extras=True)
        self._once.keep(case, method, id, row)
        return row

    def _flown(
        self, case: Case, method: Method, place: Place, memory: Memory | None = None, *, extras: bool = False
    ) -> Row:  # fmt: skip
        """An episode, with `extras` also what is only measured beside it, in the repetitions in which that is due.

        Raises `Accident` if a question got no answer: the unit is tried again by the next start.
        """
        planner, suite, k = self._planners.of(method, case.robot), self._suite, case.repetition
        before = planner.asked
        means = self._means(place, planner, memory)
        if extras and is_due(suite.free, k):
            means = replace(means, unbound=self._planners.unbound(method, case.robot))
        flight = fly(case, method, means)
        for attempt in flight.episode.attempts:
            refuse_accident(attempt.proposal)
        place = replace(place, asked=planner.asked > before and planner_name(suite, method) not in DRAWN)
        if extras and memory is not None and method.remembers and is_due(suite.memory.utility, k):
            flight = self._with_uses(flight, planner, case)
        if extras and method.guard and is_due(suite.bare, k):
            place = replace(place, lost_s=seconds_lost(case, flight, self._at.clock))
        if memory is not None:
            learns = rule(method, self._at.epsilon[case.robot])
            epsilon = learns.epsilon if learns else None
            place = replace(place, memories=len(memory), ledger=memory.ledger.head().hash, epsilon=epsilon)
        return account(case, method, flight, place)

    def _means(self, place: Place, planner: KeepingPlanner, memory: Memory | None) -> Means:
        return Means(
            f"e-{place.order:04d}" if memory is None else plain(place.key), planner, self._at.clock, memory,
            when(place.order), self._suite.shots, self._suite.planning_time,
        )  # fmt: skip

    def _with_uses(self, flight: Flight, planner: KeepingPlanner, case: Case) -> Flight:
        """The flight with what became of each exemplar in its prompt."""
        asking = Counterfactuals(planner, vocabulary(case.robot), self._at.out / "counterfactuals")
        return replace(flight, episode=msgspec.structs.replace(flight.episode, uses=asking.uses(flight.episode)))

    def _plan(self, unit: Unit, method: Method) -> Iterator[dict[str, Any]]:
        """Ask the questions of `unit`, `TOGETHER` at a time, and keep the answers; nothing moves."""
        left = list(unit.order)
        for start in range(unit.done, len(left), TOGETHER):
            cases = [
                self._at.catalogue(unit.task, seed, unit.robot, repetition)
                for seed, repetition in left[start : start + TOGETHER]
            ]
            for order, line in enumerate(self._asked(cases, method, unit.robot), start=start):
                yield {"key": unit.row_key(order), **line}

    def _asked(self, cases: Sequence[Case], method: Method, robot: str) -> Iterator[dict[str, Any]]:
        """The questions of `cases`, asked side by side where the planner can."""
        planner, listening = self._planners.of(method, robot), _Listening()
        for case in cases:
            fly(case, method, Means("plan", listening, self._at.clock, planning_time=0.0))
        fresh = [not planner.knows(request) for request in listening.heard]
        begun = self._at.clock()
        if any(fresh):
            planner.fill([request for request, new in zip(listening.heard, fresh, strict=True) if new])
        each = (self._at.clock() - begun) / max(1, sum(fresh))
        for new in fresh:
            yield {"asked": int(new), "planner_s": each if new else 0.0}

    # --- with memory ----------------------------------------------------------------------------------------------

    def _with_ledger(self, unit: Unit, method: Method, case: Case, order: int) -> dict[str, Any]:
        """One episode on the ledger that those before it left; of the start, nothing is recalled and nothing learnt."""
        now, plasticity = when(order), rule(method, self._at.epsilon.get(unit.robot, 0.0))
        place = Place(unit.row_key(order), self._suite.name, unit.cluster, order, asked=False)
        with (
            self._folder(unit).step(order, self._start(unit)) as ledger,
            memory_at(ledger, unit.robot, self._encoder, plasticity, now) as memory,
        ):
            return _line(self._flown(case, method, place, memory, extras=unit.stage == "fly"))

    def _folder(self, unit: Unit) -> RunFolder:
        return RunFolder(self._at.out / (STARTS if unit.stage == "start" else RUNS) / plain(unit.key))

    def _start(self, unit: Unit) -> Path | None:
        """The common ledger from which every run on this robot and task starts."""
        count = self._suite.memory.start
        if unit.stage == "start" or not count:
            return None
        key = f"start {unit.robot} {unit.task.errand}"
        return RunFolder(self._at.out / STARTS / plain(key)).after(count)


class _Listening:
    """Hears the questions and says nothing: no contract is carried out."""

    name = "nobody"

    def __init__(self) -> None:
        self.heard = list[PlanRequest]()

    def propose(self, request: PlanRequest) -> Proposal:
        self.heard.append(request)
        return Proposal("", "only heard", self.name, "", {"total": 0.0})

    def close(self) -> None:
        """Nothing to let go of."""


def _line(row: Row) -> dict[str, Any]:
    return msgspec.to_builtins(row)
