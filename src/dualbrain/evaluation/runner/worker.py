"""How one unit is carried out: its episodes in order, each a line for the journal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.evaluation.episodes.case_runner import Clock, EpisodeResources, EpisodeRun, run_case
from dualbrain.evaluation.episodes.episode_cache import EpisodeCache
from dualbrain.evaluation.episodes.intervention_time import seconds_lost
from dualbrain.evaluation.episodes.scoring import EpisodeContext, score_episode
from dualbrain.evaluation.planners.answer_cache import AnswerCache, CachingPlanner, require_answer
from dualbrain.evaluation.planners.factory import RANDOM_PLANNERS, PlannerFactory, PlannerSources, planner_name
from dualbrain.evaluation.protocol.case import Case, CaseFactory, make_case
from dualbrain.evaluation.protocol.method import Method, find_method
from dualbrain.evaluation.protocol.suite import Suite, is_due
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.evaluation.runner.run_ledgers import RunFolder, episode_time, folder_name, open_memory, plasticity_rule
from dualbrain.evaluation.runner.work_units import WorkUnit
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.memory.embedding.text_encoder import Encoder, MiniLmEncoder
from dualbrain.memory.memory import Memory
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal
from dualbrain.runtime.counterfactual import CounterfactualQueries

PLAN_BATCH_SIZE = 16
"""Questions of the plan pass between two lines of its journal: what is asked side by side, and lost by a kill."""
ANSWERS_FOLDER, RUNS_FOLDER, START_FOLDER, EPISODE_CACHE_FOLDER = "plans", "runs", "start", "once"


@dataclass(frozen=True, kw_only=True)
class WorkerConfig:
    """What every worker is given: suite, folders, ε, the clock that only measures."""

    suite: Suite
    out: Path
    sources: PlannerSources
    clock: Clock
    epsilon: dict[str, float]
    """ε by robot."""
    make_case: CaseFactory = make_case

    def make_worker(self) -> Worker:
        """A worker's own `Work`."""
        return Worker(self)


class Worker:
    """Carries out units; called with one, it yields the lines of the episodes that are not done yet."""

    def __init__(self, config: WorkerConfig) -> None:
        """Planners and encoder are opened when they are first needed."""
        self._config, self._suite = config, config.suite
        self._planners = PlannerFactory(config.suite, config.sources, AnswerCache(config.out / ANSWERS_FOLDER))
        self._episode_cache = EpisodeCache(config.out / EPISODE_CACHE_FOLDER)

    @cached_property
    def _encoder(self) -> Encoder:
        return MiniLmEncoder.from_cache(self._config.sources.cache)

    def __call__(self, unit: WorkUnit) -> Iterator[dict[str, Any]]:
        """The lines of `unit` from its episode number `done` on."""
        method = find_method(unit.method)
        if unit.stage == "plan":
            yield from self._plan(unit, method)
            return
        for order, (seed, repetition) in enumerate(unit.seed_repetition_pairs):
            if order < unit.done:
                continue
            case = self._config.make_case(unit.task, seed, unit.robot, repetition)
            if unit.stage == "start" or method.uses_memory:
                yield self._run_with_ledger(unit, method, case, order)
            else:
                place = EpisodeContext(
                    key=unit.row_key(order), suite=self._suite.name, cluster=unit.cluster, order=order, asked=False
                )
                row = (
                    self._run_cached(case, method, place)
                    if unit.stage == "fly"
                    else self._run_episode(case, method, place)
                )
                yield _encode_row(row)
        if unit.stage == "start" or method.uses_memory:
            self._run_folder(unit).remove_old_ledgers(unit.n_episodes)

    def close(self) -> None:
        """Let go of the planners."""
        self._planners.close()

    # --- one episode ----------------------------------------------------------------------------------------------

    def _run_cached(self, case: Case, method: Method, place: EpisodeContext) -> EpisodeRow:
        """The episode of a method without memory, unless it was flown behind another door."""
        id = self._planners.get(method, case.robot).name
        known = self._episode_cache.get(case, method, id, place.key)
        if known is not None:
            return known
        row = self._run_episode(case, method, place, extras=True)
        self._episode_cache.put(case, method, id, row)
        return row

    def _run_episode(
        self, case: Case, method: Method, place: EpisodeContext, memory: Memory | None = None, *, extras: bool = False
    ) -> EpisodeRow:
        """An episode, with `extras` also what is only measured beside it, in the repetitions in which that is due.

        Raises `Accident` if a question got no answer: the unit is tried again by the next start.
        """
        planner, suite, k = self._planners.get(method, case.robot), self._suite, case.repetition
        before = planner.n_requests
        means = self._resources(place, planner, memory)
        if extras and is_due(suite.free, k):
            means = replace(means, unconstrained_planner=self._planners.get_unconstrained(method, case.robot))
        flight = run_case(case, method, means)
        for attempt in flight.episode.attempts:
            require_answer(attempt.proposal)
        place = replace(place, asked=planner.n_requests > before and planner_name(suite, method) not in RANDOM_PLANNERS)
        if extras and memory is not None and method.uses_memory and is_due(suite.memory.utility, k):
            flight = self._add_memory_uses(flight, planner, case)
        if extras and method.guard and is_due(suite.bare, k):
            place = replace(place, lost_s=seconds_lost(case, flight, self._config.clock))
        if memory is not None:
            learns = plasticity_rule(method, self._config.epsilon[case.robot])
            epsilon = learns.epsilon if learns else None
            place = replace(place, memories=len(memory), ledger=memory.ledger.head().hash, epsilon=epsilon)
        return score_episode(case, method, flight, place)

    def _resources(self, place: EpisodeContext, planner: CachingPlanner, memory: Memory | None) -> EpisodeResources:
        return EpisodeResources(
            id=f"e-{place.order:04d}" if memory is None else folder_name(place.key),
            planner=planner,
            clock=self._config.clock,
            memory=memory,
            now=episode_time(place.order),
            max_shots=self._suite.shots,
            planning_time=self._suite.planning_time,
        )

    def _add_memory_uses(self, flight: EpisodeRun, planner: CachingPlanner, case: Case) -> EpisodeRun:
        """The flight with what became of each exemplar in its prompt."""
        asking = CounterfactualQueries(planner, load_skill_registry(case.robot), self._config.out / "counterfactuals")
        return replace(flight, episode=msgspec.structs.replace(flight.episode, uses=asking.memory_uses(flight.episode)))

    def _plan(self, unit: WorkUnit, method: Method) -> Iterator[dict[str, Any]]:
        """Ask the questions of `unit`, `TOGETHER` at a time, and keep the answers; nothing moves."""
        left = list(unit.seed_repetition_pairs)
        for start in range(unit.done, len(left), PLAN_BATCH_SIZE):
            cases = [
                self._config.make_case(unit.task, seed, unit.robot, repetition)
                for seed, repetition in left[start : start + PLAN_BATCH_SIZE]
            ]
            for order, line in enumerate(self._plan_batch(cases, method, unit.robot), start=start):
                yield {"key": unit.row_key(order), **line}

    def _plan_batch(self, cases: Sequence[Case], method: Method, robot: str) -> Iterator[dict[str, Any]]:
        """The questions of `cases`, asked side by side where the planner can."""
        planner, listening = self._planners.get(method, robot), _RequestCollector()
        for case in cases:
            run_case(
                case,
                method,
                EpisodeResources(id="plan", planner=listening, clock=self._config.clock, planning_time=0.0),
            )
        fresh = [not planner.is_cached(request) for request in listening.requests]
        begun = self._config.clock()
        if any(fresh):
            planner.propose_uncached([request for request, new in zip(listening.requests, fresh, strict=True) if new])
        each = (self._config.clock() - begun) / max(1, sum(fresh))
        for new in fresh:
            yield {"asked": int(new), "planner_s": each if new else 0.0}

    # --- with memory ----------------------------------------------------------------------------------------------

    def _run_with_ledger(self, unit: WorkUnit, method: Method, case: Case, order: int) -> dict[str, Any]:
        """One episode on the ledger that those before it left; of the start, nothing is recalled and nothing learnt."""
        now, plasticity = episode_time(order), plasticity_rule(method, self._config.epsilon.get(unit.robot, 0.0))
        place = EpisodeContext(
            key=unit.row_key(order), suite=self._suite.name, cluster=unit.cluster, order=order, asked=False
        )
        with (
            self._run_folder(unit).open_episode(order, self._start_ledger(unit)) as ledger,
            open_memory(ledger, unit.robot, self._encoder, plasticity, now) as memory,
        ):
            return _encode_row(self._run_episode(case, method, place, memory, extras=unit.stage == "fly"))

    def _run_folder(self, unit: WorkUnit) -> RunFolder:
        return RunFolder(
            self._config.out / (START_FOLDER if unit.stage == "start" else RUNS_FOLDER) / folder_name(unit.key)
        )

    def _start_ledger(self, unit: WorkUnit) -> Path | None:
        """The common ledger from which every run on this robot and task starts."""
        count = self._suite.memory.start
        if unit.stage == "start" or not count:
            return None
        key = f"start {unit.robot} {unit.task.base_name}"
        return RunFolder(self._config.out / START_FOLDER / folder_name(key)).folder_after(count)


class _RequestCollector:
    """Hears the questions and says nothing: no contract is carried out."""

    name = "nobody"

    def __init__(self) -> None:
        self.requests = list[PlanRequest]()

    def propose(self, request: PlanRequest) -> Proposal:
        self.requests.append(request)
        return Proposal(
            text="", finish_reason="only heard", planner=self.name, constrained_by="", timings={"total": 0.0}
        )

    def close(self) -> None:
        """Nothing to let go of."""


def _encode_row(row: EpisodeRow) -> dict[str, Any]:
    return msgspec.to_builtins(row)
