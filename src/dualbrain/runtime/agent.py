"""The agent of an episode: planner, episodic memory and documents. Nothing in here can move the robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.memory import StoreReport
from dualbrain.planner.protocol import Planner
from dualbrain.records import Episode, Passage
from dualbrain.runtime.planning.planner_request import PassageRetriever, Retriever


class EpisodicMemory(Retriever, Protocol):
    """Interface of memory: `memory.memory.Memory`, or a baseline that stores nothing."""

    def store(self, episode: Episode, state: Posture, *, now: float, image: ImageFeatures | None = None) -> StoreReport:
        """Store the episode and update weights by its outcome; `now` in [s, 1970 UTC]."""
        ...


def no_passages(instruction: str, summary: str) -> tuple[Passage, ...]:
    """No documents."""
    del instruction, summary
    return ()


@dataclass(frozen=True, slots=True)
class Agent:
    """A `planner` with its `memory`: the part of a run that proposes contracts and learns; see `dualbrain.run`.

    `memory` is a `Memory`, or any object with its methods `retrieve` and `store`. `retrieve_passages` maps the
    instruction and the scene summary, two texts, to a tuple of document passages; by default there are none.
    """

    planner: Planner
    memory: EpisodicMemory
    retrieve_passages: PassageRetriever = no_passages
