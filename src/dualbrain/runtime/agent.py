"""The agent of an episode: planner, episodic memory and documents. Nothing in here can move the robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.memory import StoreReport
from dualbrain.planner.protocol import Planner
from dualbrain.records import Episode, Passage
from dualbrain.runtime.planner_request import PassageRetriever, Retriever


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
    """A `planner` with its `memory`; `retrieve_passages` returns the document passages for an instruction and scene."""

    planner: Planner
    memory: EpisodicMemory
    retrieve_passages: PassageRetriever = no_passages
