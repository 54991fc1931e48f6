"""Workers: carry out one unit, episode by episode, each of which yields a line for the log."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.core.encoder import Encoder
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
from dualbrain.memory.embedding.text_encoder import MiniLmEncoder
from dualbrain.memory.memory import Memory
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal
from dualbrain.runtime.inspection.counterfactual import CounterfactualQueries
from dualbrain.runtime.planning.reuse.reused_contract import is_reused

PLAN_BATCH_SIZE = 16
"""Requests of the plan stage in one batch: they are answered in parallel where the planner can, and lost by a kill."""
ANSWERS_FOLDER, RUNS_FOLDER, START_FOLDER, EPISODE_CACHE_FOLDER = "plans", "runs", "start", "once"
COUNTERFACTUALS_FOLDER = "counterfactuals"


@dataclass(frozen=True, kw_only=True)
class WorkerConfig:
    """Configuration of all workers: suite, results folder, sources of planners, ε, and the `clock` for timings [s]."""

    suite: Suite
    out: Path
    sources: PlannerSources
    clock: Clock
    epsilon: dict[str, float]
    """ε by robot."""
    make_case: CaseFactory = make_case

    def make_worker(self) -> Worker:
        """A worker for one process."""
        return Worker(self)


class Worker:
    """Carries out units; called with one, it yields the lines of the episodes that are not finished."""

    def __init__(self, config: WorkerConfig) -> None:
        """Planners and text encoder are opened when they are first needed."""
        self._config, self._suite = config, config.suite
        self._planners = PlannerFactory(config.suite, config.sources, AnswerCache(config.out / ANSWERS_FOLDER))
        self._episode_cache = EpisodeCache(config.out / EPISODE_CACHE_FOLDER)

    @cached_property
    def _encoder(self) -> Encoder:
        return MiniLmEncoder.from_cache(self._config.sources.cache)

    def __call__(self, unit: WorkUnit) -> Iterator[dict[str, Any]]:
        """The lines of `unit` from episode number `unit.done` on."""
        method = find_method(unit.method)
        if unit.stage == "plan":
            yield from self._plan(unit, method)
        elif unit.stage == "start" or method.uses_memory:
            yield from self._run_all_with_ledger(unit, method)
        else:
            run = self._run_cached if unit.stage == "fly" else self._run_episode
            for order, case in self._cases(unit, unit.done):
                yield _encode_row(run(case, method, self._context(unit, order)))

    def close(self) -> None:
        """Close the planners."""
        self._planners.close()

    def _cases(self, unit: WorkUnit, first: int) -> Iterator[tuple[int, Case]]:
        """Numbers and cases of the episodes of `unit` from number `first` on."""
        for order, (seed, repetition) in enumerate(unit.seed_repetition_pairs):
            if order >= first:
                yield order, self._config.make_case(unit.task, seed, unit.robot, repetition)

    # --- one episode ----------------------------------------------------------------------------------------------

    def _context(self, unit: WorkUnit, order: int) -> EpisodeContext:
        """The context of episode number `order` of `unit`, as far as it is known before the episode."""
        return EpisodeContext(
            key=unit.row_key(order), suite=self._suite.name, cluster=unit.cluster, order=order, asked=False
        )

    def _run_cached(self, case: Case, method: Method, context: EpisodeContext) -> EpisodeRow:
        """The episode of a method without memory, from the cache if a method with another gate has the same one."""
        id = self._planners.get(method, case.robot).name
        known = self._episode_cache.get(case, method, id, context.key)
        if known is not None:
            return known
        row = self._run_episode(case, method, context, extras=True)
        self._episode_cache.put(case, method, id, row)
        return row

    def _run_episode(
        self, case: Case, method: Method, context: EpisodeContext, memory: Memory | None = None, *, extras: bool = False
    ) -> EpisodeRow:
        """One episode; with `extras` also the additional measurements, in the repetitions in which they are due.

        Raises `NoAnswerError` if the planner did not answer a request: the next start tries the unit again.
        """
        planner, suite, k = self._planners.get(method, case.robot), self._suite, case.repetition
        before = planner.n_requests
        resources = self._resources(context, planner, memory)
        if extras and is_due(suite.free, k):
            resources = replace(resources, unconstrained_planner=self._planners.get_unconstrained(method, case.robot))
        run = run_case(case, method, resources)
        for attempt in run.episode.attempts:
            require_answer(attempt.proposal)
        asked = planner.n_requests > before and planner_name(suite, method) not in RANDOM_PLANNERS
        context = replace(context, asked=asked or is_reused(run.episode))
        if extras and memory is not None and method.uses_memory and is_due(suite.memory.utility, k):
            run = self._add_memory_uses(run, planner, case)
        if extras and method.guard and is_due(suite.bare, k):
            context = replace(context, lost_s=seconds_lost(case, run, self._config.clock))
        if memory is not None:
            rule = plasticity_rule(method, self._config.epsilon[case.robot])
            epsilon = rule.epsilon if rule else None
            context = replace(context, memories=len(memory), ledger=memory.ledger.head().hash, epsilon=epsilon)
        return score_episode(case, method, run, context)

    def _resources(self, context: EpisodeContext, planner: CachingPlanner, memory: Memory | None) -> EpisodeResources:
        return EpisodeResources(
            id=f"e-{context.order:04d}" if memory is None else folder_name(context.key),
            planner=planner,
            clock=self._config.clock,
            memory=memory,
            now=episode_time(context.order),
            max_shots=self._suite.shots,
            planning_time=self._suite.planning_time,
            target=self._suite.target,
        )

    def _add_memory_uses(self, run: EpisodeRun, planner: CachingPlanner, case: Case) -> EpisodeRun:
        """`run` with the uses of the exemplars in its prompt, found by requests without each of them."""
        queries = CounterfactualQueries(
            planner, load_skill_registry(case.robot), self._config.out / COUNTERFACTUALS_FOLDER
        )
        return replace(run, episode=msgspec.structs.replace(run.episode, uses=queries.memory_uses(run.episode)))

    def _plan(self, unit: WorkUnit, method: Method) -> Iterator[dict[str, Any]]:
        """Make the requests of `unit` in batches of `PLAN_BATCH_SIZE` and cache the answers; nothing moves."""
        left = list(unit.seed_repetition_pairs)
        for start in range(unit.done, len(left), PLAN_BATCH_SIZE):
            cases = [
                self._config.make_case(unit.task, seed, unit.robot, repetition)
                for seed, repetition in left[start : start + PLAN_BATCH_SIZE]
            ]
            for order, line in enumerate(self._plan_batch(cases, method, unit.robot), start=start):
                yield {"key": unit.row_key(order), **line}

    def _plan_batch(self, cases: Sequence[Case], method: Method, robot: str) -> Iterator[dict[str, Any]]:
        """The requests of `cases`, answered in parallel where the planner can; a case that asks no planner has none."""
        planner, collector = self._planners.get(method, robot), _RequestCollector()
        asks: list[bool] = []
        for case in cases:
            before = len(collector.requests)
            run_case(
                case,
                method,
                EpisodeResources(id="plan", planner=collector, clock=self._config.clock, planning_time=0.0),
            )
            asks.append(len(collector.requests) > before)
        fresh = [not planner.is_cached(request) for request in collector.requests]
        start = self._config.clock()
        if any(fresh):
            planner.propose_uncached([request for request, new in zip(collector.requests, fresh, strict=True) if new])
        each = (self._config.clock() - start) / max(1, sum(fresh))
        answered = iter(fresh)
        for new in (asked and next(answered) for asked in asks):
            yield {"asked": int(new), "planner_s": each if new else 0.0}

    # --- with memory ----------------------------------------------------------------------------------------------

    def _run_all_with_ledger(self, unit: WorkUnit, method: Method) -> Iterator[dict[str, Any]]:
        """The lines of a run with memory from episode number `unit.done` on.

        Episodes before it run again, without a line, if the ledger that they left was removed.
        """
        folder = self._run_folder(unit)
        for order, case in self._cases(unit, folder.first_episode_to_run(unit.done)):
            line = self._run_with_ledger(unit, method, case, order)
            if order >= unit.done:
                yield line
        folder.remove_old_ledgers(unit.n_episodes)

    def _run_with_ledger(self, unit: WorkUnit, method: Method, case: Case, order: int) -> dict[str, Any]:
        """One episode on the ledger that the episodes before it left.

        Episodes of the start stage only store: they retrieve nothing, and no weight changes.
        """
        now, plasticity = episode_time(order), plasticity_rule(method, self._config.epsilon.get(unit.robot, 0.0))
        context = self._context(unit, order)
        with (
            self._run_folder(unit).open_episode(order, self._start_ledger(unit)) as ledger,
            open_memory(ledger, unit.robot, self._encoder, plasticity, now) as memory,
        ):
            return _encode_row(self._run_episode(case, method, context, memory, extras=unit.stage == "fly"))

    def _run_folder(self, unit: WorkUnit) -> RunFolder:
        return RunFolder(
            self._config.out / (START_FOLDER if unit.stage == "start" else RUNS_FOLDER) / folder_name(unit.key)
        )

    def _start_ledger(self, unit: WorkUnit) -> Path | None:
        """The common ledger from which every run with this robot and task starts."""
        count = self._suite.memory.start
        if unit.stage == "start" or not count:
            return None
        key = f"start {unit.robot} {unit.task.base_name}"
        return RunFolder(self._config.out / START_FOLDER / folder_name(key)).folder_after(count)


class _RequestCollector:
    """A planner that records the requests and answers none, so that no contract is carried out."""

    name = "request collector"

    def __init__(self) -> None:
        self.requests = list[PlanRequest]()

    def propose(self, request: PlanRequest) -> Proposal:
        self.requests.append(request)
        return Proposal(text="", finish_reason="recorded only", planner=self.name, timings={"total": 0.0})

    def close(self) -> None:
        """Nothing is open."""


def _encode_row(row: EpisodeRow) -> dict[str, Any]:
    """The row as JSON values: a number that is not finite becomes None."""
    return msgspec.json.decode(msgspec.json.encode(row))
