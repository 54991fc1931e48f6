"""Counterfactual proposals: what the planner proposes for the same request without one memory, with a cache."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.schema import describe_skills
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.storage.private_files import open_private_folder
from dualbrain.errors import DECODE_ERRORS
from dualbrain.grounding.scene_summary import held_in_summary, summarise_scene
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.memory.plasticity.retrieval_utility import ExclusionEffect, evaluate_use
from dualbrain.planner.introspection import planner_template
from dualbrain.planner.prompt.full_prompt import render
from dualbrain.planner.protocol import LENGTH, STOP, Planner
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Episode, Exemplar, MemoryUse
from dualbrain.runtime.planning.planner_request import answer_schema, in_prompt_order
from dualbrain.runtime.planning.reuse.reused_contract import has_reused_contract


class CounterfactualQueries:
    """Sends counterfactual requests to a planner; the answer to each request is cached permanently.

    Assumption: the planner is deterministic (greedy decoding); otherwise a difference may be chance.
    """

    def __init__(self, planner: Planner, registry: SkillRegistry, cache: Path) -> None:
        """Request contracts with skills of `registry` from `planner`; store answers in the folder `cache`."""
        self._planner, self._registry, self._cache = planner, registry, cache

    def memory_uses(
        self, episode: Episode, *, should_stop: Callable[[], bool] = lambda: False
    ) -> tuple[MemoryUse, ...]:
        """The use of each exemplar in the prompt of `episode`, until `should_stop` returns True.

        None if a contract of memory was proposed: then the first proposal is not an answer of the planner to a prompt.
        If the planner gives no answer (a crash, a timeout, an error of its server), the remaining uses are left out.
        """
        if has_reused_contract(episode):
            return ()
        first = _parse_contract(episode.attempts[0].proposal.text) if episode.attempts else None
        found: list[MemoryUse] = []
        for exemplar in episode.recall.exemplars:
            answer = None if should_stop() else self._propose_cached(self.build_request(episode, exemplar))
            if answer is None:
                break
            found.append(
                evaluate_use(
                    exemplar.episode_id,
                    exemplar.contract,
                    episode.contract,
                    ExclusionEffect(first, _parse_contract(answer)),
                    succeeded=episode.outcome.kind == "succeeded",
                    Delta=episode.outcome.Delta,
                    max_Delta=exemplar.Delta,
                )
            )
        return tuple(found)

    def build_request(self, episode: Episode, excluded: Exemplar) -> PlanRequest:
        """The first request of `episode`, without the exemplar `excluded`; the schema has no bound by the reach."""
        remaining = tuple(one for one in episode.recall.exemplars if one.episode_id != excluded.episode_id)
        recall = in_prompt_order(msgspec.structs.replace(episode.recall, exemplars=remaining), self._registry)
        names = scene_names(episode.scene)
        return PlanRequest(
            instruction=episode.instruction,
            scene=episode.summary,
            recall=recall,
            robot=episode.robot,
            registry_hash=episode.registry,
            skills_text=describe_skills(self._registry, names),
            schema=answer_schema(episode.instruction, episode.scene, self._registry, held_in_summary(episode.summary)),
            contract_id="c-0001",
            failure_feedback=episode.failure_feedback,
            scene_with_values=summarise_scene(episode.scene, held_in_summary(episode.summary), values=True),
        )

    def _propose_cached(self, request: PlanRequest) -> str | None:
        """The answer, "" if it was cut at its limit; None if there is none, which is not cached."""
        planner = [self._planner.name, planner_template(self._planner)]
        key = json.dumps([planner, render(request), request.schema], sort_keys=True)
        path = self._cache / f"{hashlib.sha256(key.encode()).hexdigest()}.json"
        if (cached := _read_cached(path)) is not None:
            return cached
        proposal = self._planner.propose(request)
        if proposal.finish_reason not in (STOP, LENGTH):
            return None
        text = proposal.text if proposal.finish_reason == STOP else ""
        open_private_folder(self._cache)
        write_atomically(path, json.dumps({"planner": self._planner.name, "text": text}).encode())
        return text


def _read_cached(path: Path) -> str | None:
    """The cached answer in the file `path`; None if there is none, or if it cannot be read."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=dict[str, str])["text"]
    except (FileNotFoundError, KeyError, *DECODE_ERRORS):
        return None


def _parse_contract(text: str) -> dict[str, Any] | None:
    """The JSON object in an answer, None if there is none."""
    try:
        return msgspec.json.decode(text, type=dict[str, Any])
    except DECODE_ERRORS:
        return None
