"""What the planner would have proposed without one memory: the question asked again, its answer kept in a cache."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.contracts.schema import short_form
from dualbrain.memory.utility import Use, judge
from dualbrain.planner.prompt import render
from dualbrain.planner.protocol import STOP, Planner
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Episode, Exemplar, Recall
from dualbrain.runtime.vocabulary import scene_names, vocabulary


class Counterfactuals:
    """Asks `planner` counterfactual questions; the same question to the same planner is asked once and for all.

    Assumption: the planner is deterministic (greedy decoding), as ours are; else a difference may be chance.
    """

    def __init__(self, planner: Planner, cache: Path) -> None:
        """Keep answers in the folder `cache`."""
        self._planner, self._cache = planner, cache
        cache.mkdir(parents=True, exist_ok=True)

    def uses(self, episode: Episode) -> tuple[Use, ...]:
        """What became of each exemplar that stood in the prompt of `episode`."""
        outcome = episode.outcome
        return tuple(
            judge(
                exemplar.episode_id, exemplar.contract, episode.contract, self.without(episode, exemplar),
                succeeded=outcome.kind == "succeeded", Delta=outcome.Delta, reference=exemplar.Delta,
            )
            for exemplar in episode.recall.exemplars
        )  # fmt: skip

    def without(self, episode: Episode, exemplar: Exemplar) -> dict[str, Any] | None:
        """The contract proposed at the first shot when `exemplar` is left out; None if the answer is no JSON object."""
        left = tuple(one for one in episode.recall.exemplars if one.episode_id != exemplar.episode_id)
        request = _question(episode, msgspec.structs.replace(episode.recall, exemplars=left))
        try:
            return msgspec.json.decode(self._ask(request), type=dict[str, Any])
        except msgspec.DecodeError:
            return None

    def _ask(self, request: PlanRequest) -> str:
        asked = json.dumps([self._planner.name, render(request), request.schema], sort_keys=True)
        path = self._cache / f"{hashlib.sha256(asked.encode()).hexdigest()}.json"
        if path.exists():
            return str(json.loads(path.read_text())["text"])
        proposal = self._planner.propose(request)
        text = proposal.text if proposal.finish_reason == STOP else ""
        path.write_text(json.dumps({"planner": self._planner.name, "text": text}))
        return text


def _question(episode: Episode, recall: Recall) -> PlanRequest:
    """The first question of `episode` with another recall."""
    registry, names = vocabulary(episode.robot), scene_names(episode.scene)
    return PlanRequest(
        episode.instruction, episode.summary, recall, episode.robot, registry.hash, short_form(registry, names),
        registry.decoding_schema(names), contract_id="c-0001",
    )  # fmt: skip
