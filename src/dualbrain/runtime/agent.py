"""The agent of an episode: planner, episodic memory and documents. Nothing in here can move the robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from dualbrain.grounding.instruction.clauses.clause_classifier import ClauseClassifier
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.ledger.hash_chain import Head
from dualbrain.memory.memory import StoreReport
from dualbrain.planner.protocol import Planner
from dualbrain.records import Episode, Passage, Precedent, RetrievedContext
from dualbrain.runtime.planning.planner_request import PassageRetriever, Retriever


class EpisodicMemory(Retriever, Protocol):
    """Interface of memory: `memory.memory.Memory`, or a baseline that stores nothing."""

    def store(self, episode: Episode, state: Posture, *, now: float, image: ImageFeatures | None = None) -> StoreReport:
        """Store the episode and update weights by its outcome; `now` in [s, 1970 UTC]."""
        ...


class NoMemory:
    """A memory that stores nothing and retrieves nothing."""

    def retrieve(
        self,
        instruction: str,
        summary: str,
        state: Posture | None,
        robot: str,
        registry: str,
        *,
        k: int,
        image: ImageFeatures | None = None,
    ) -> RetrievedContext:
        """An empty context."""
        del instruction, summary, state, robot, registry, k, image
        return RetrievedContext()

    def find_precedents(
        self, summary: str, state: Posture | None, robot: str, registry: str, *, max_count: int
    ) -> tuple[Precedent, ...]:
        """No precedents."""
        del summary, state, robot, registry, max_count
        return ()

    def find_outcomes(
        self, contract: dict[str, Any], robot: str, registry: str, *, max_count: int
    ) -> tuple[Precedent, ...]:
        """No outcomes."""
        del contract, robot, registry, max_count
        return ()

    def store(self, episode: Episode, state: Posture, *, now: float, image: ImageFeatures | None = None) -> StoreReport:
        """Store nothing; no weight changes."""
        del state, now, image
        return StoreReport(episode_id=episode.id, seq=0, head=Head(0, ""), weight_updates=())


def no_passages(instruction: str, summary: str) -> tuple[Passage, ...]:
    """No documents."""
    del instruction, summary
    return ()


@dataclass(frozen=True, slots=True)
class Agent:
    """A `planner` with its `memory`: the part of a run that proposes contracts and learns; see `dualbrain.run`.

    `memory` is a `Memory`, or any object with its methods `retrieve`, `store` and, for the reuse of contracts,
    `find_precedents` and `find_outcomes`. `retrieve_passages` maps the instruction and the scene summary, two texts, to
    a tuple of document passages; by default there are none. `clause_classifier` helps the rules to find clauses that no
    contract can express.
    """

    planner: Planner
    memory: EpisodicMemory
    retrieve_passages: PassageRetriever = no_passages
    clause_classifier: ClauseClassifier | None = None
