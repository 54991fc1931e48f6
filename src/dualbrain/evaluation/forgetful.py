"""The experience of a method without memory: nothing is recalled, nothing is kept."""

from __future__ import annotations

from dualbrain.memory.ledger import Head
from dualbrain.memory.picture import Picture
from dualbrain.memory.posture import Posture
from dualbrain.memory.store import StoreReport
from dualbrain.records import Episode, Recall


class Forgetful:
    """Answers as a memory without memories."""

    def recall(
        self, instruction: str, summary: str, state: Posture | None, robot: str, registry: str, *, k: int,
        image: Picture | None = None,
    ) -> Recall:  # fmt: skip
        """Nothing."""
        del instruction, summary, state, robot, registry, k, image
        return Recall()

    def store(self, episode: Episode, state: Posture, *, now: float, image: Picture | None = None) -> StoreReport:
        """Keep nothing; no weight moves."""
        del state, now, image
        return StoreReport(episode.id, 0, Head(0, ""), ())
