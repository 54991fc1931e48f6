"""Defences against pollution (paper section 8): initial status of memories, and daily bounds per source."""

from __future__ import annotations

from dataclasses import dataclass

from dualbrain.errors import ConfigurationError
from dualbrain.memory.ledger.events import Status
from dualbrain.memory.plasticity.affine_map import IDENTITY, AffineMap
from dualbrain.memory.state.state import Influence
from dualbrain.records import Episode


@dataclass(frozen=True, slots=True)
class TrustConfig:
    """Settings of the defences; `TrustConfig.disabled()` switches all of them off.

    With `quarantine`, a success is a candidate until the independent senses, or a later consistent outcome that these
    senses confirm, confirm it; an outcome that the senses dispute is quarantined. `max_change_per_source` bounds Σ|Δw|
    that the outcomes of one source cause in one day over all memories, `max_change_per_memory` the part on one memory;
    an outcome that is older than the newest day of the ledger counts on that day.
    `min_similarity` is the least cosine of two situations in which the same contract counts as repeated.
    """

    quarantine: bool = True
    max_change_per_source: float = 20.0
    max_change_per_memory: float = 1.0
    min_similarity: float = 0.9

    def __post_init__(self) -> None:
        """Raise `ConfigurationError` for bounds not above 0 and a similarity outside [−1, 1]."""
        for name, value in (
            ("max_change_per_source", self.max_change_per_source),
            ("max_change_per_memory", self.max_change_per_memory),
        ):
            if not value > 0.0:
                raise ConfigurationError(f"trust {name}", got=value, allowed="above 0")
        if not -1.0 <= self.min_similarity <= 1.0:
            raise ConfigurationError("trust min_similarity", got=self.min_similarity, allowed="in [-1, 1]")

    @classmethod
    def disabled(cls) -> TrustConfig:
        """A configuration without any defence."""
        return cls(quarantine=False, max_change_per_source=float("inf"), max_change_per_memory=float("inf"))

    def initial_status(self, episode: Episode) -> Status:
        """The status of a new memory."""
        if not self.quarantine or episode.outcome.kind in ("declined", "aborted", "stopped", "rejected"):
            return "active"
        if episode.second_opinion == "disagrees":
            return "quarantined"
        unconfirmed = episode.outcome.kind == "succeeded" and episode.second_opinion != "agrees"
        return "candidate" if unconfirmed else "active"

    def limit_update(self, update: AffineMap, w: float, spent: tuple[float, float]) -> tuple[AffineMap, float]:
        """The part of an `update` of `w` that is within the bounds of its source, and the share of that part in [0, 1].

        `spent` is Σ|Δw| of the source today: over all memories, and on this memory. Promise: in one day no sequence of
        outcomes of one source changes one weight by more than `max_change_per_memory`, or all weights together by more
        than `max_change_per_source`.
        """
        change = abs(update.gain * w + update.offset - w)
        budget = min(self.max_change_per_source - spent[0], self.max_change_per_memory - spent[1])
        if change <= budget or change == 0.0:
            return update, 1.0
        share = max(0.0, budget) / change
        return (update.scale_step(share) if share else IDENTITY), share


class InfluenceBudget:
    """The changes that one source has caused today: those in the state, and those of the episode being stored."""

    def __init__(self, influence: Influence, day: int, source: str) -> None:
        """Create the budget of `source` on `day` (days since 1970) with the changes in `influence`."""
        self._influence, self._day, self._source = influence, day, source
        self._total = 0.0
        self._single: dict[str, float] = {}

    def accumulated_change(self, memory: str) -> tuple[float, float]:
        """Σ|Δw| of the source today: over all memories, and on `memory`."""
        total, single = self._influence.accumulated_change(self._day, self._source, memory)
        return total + self._total, single + self._single.get(memory, 0.0)

    def add(self, memory: str, change: float) -> None:
        """Add a `change` |Δw| of the weight of `memory`."""
        self._total += change
        self._single[memory] = self._single.get(memory, 0.0) + change
