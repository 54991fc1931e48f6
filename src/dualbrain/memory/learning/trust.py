"""Against pollution (paper section 8): who is believed at once, and how far one source may move weights in a day."""

from __future__ import annotations

from dataclasses import dataclass

from dualbrain.errors import ConfigurationError
from dualbrain.memory.ledger.events import Status
from dualbrain.memory.plasticity.affine_map import IDENTITY, AffineMap
from dualbrain.memory.state.state import Influence
from dualbrain.records import Episode


@dataclass(frozen=True, slots=True)
class TrustConfig:
    """The dials of the defences; `Trust.none()` switches all of them off.

    `quarantine`: a success is a candidate until another of the robot's senses, or a later consistent outcome that is
    believed, confirms it; a verdict that another sense disputes is set aside. `per_source` bounds Σ|Δw| that the
    outcomes of one source cause in one day over all memories, `per_memory` what they cause on one memory.
    `alike` is the least cosine of two situations in which the same contract counts as tried again.
    """

    quarantine: bool = True
    max_change_per_source: float = 20.0
    max_change_per_memory: float = 1.0
    min_similarity: float = 0.9

    def __post_init__(self) -> None:
        """Raise `InvalidSetup` for bounds that are no bounds."""
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
        """No defence at all."""
        return cls(quarantine=False, max_change_per_source=float("inf"), max_change_per_memory=float("inf"))

    def initial_status(self, episode: Episode) -> Status:
        """The status with which a new memory begins."""
        if not self.quarantine or episode.outcome.kind in ("declined", "aborted", "stopped", "rejected"):
            return "active"
        if episode.second_opinion == "disagrees":
            return "quarantined"
        waits = episode.outcome.kind == "succeeded" and episode.second_opinion != "agrees"
        return "candidate" if waits else "active"

    def limit_update(self, factors: AffineMap, w: float, spent: tuple[float, float]) -> tuple[AffineMap, float]:
        """The part of a step from `w` that the source may still make, and its share in [0, 1].

        `spent` is Σ|Δw| of the source today: over all memories, and on this one. Promise: no sequence of outcomes
        of one source moves one memory further than `per_memory`, or all together further than `per_source`, in one day.
        """
        wanted = abs(factors.gain * w + factors.offset - w)
        room = min(self.max_change_per_source - spent[0], self.max_change_per_memory - spent[1])
        if wanted <= room or wanted == 0.0:
            return factors, 1.0
        share = max(0.0, room) / wanted
        return (factors.scale_step(share) if share else IDENTITY), share


class InfluenceBudget:
    """The influence spent today, read from the state, plus what one store is about to spend."""

    def __init__(self, influence: Influence, day: int, source: str) -> None:
        """Begin with what the events say of `source` on `day`."""
        self._influence, self._day, self._source = influence, day, source
        self._total = 0.0
        self._single: dict[str, float] = {}

    def accumulated_change(self, memory: str) -> tuple[float, float]:
        """Σ|Δw| of the source today: over all memories, and on `memory`."""
        total, single = self._influence.accumulated_change(self._day, self._source, memory)
        return total + self._total, single + self._single.get(memory, 0.0)

    def add(self, memory: str, moved: float) -> None:
        """Count a move."""
        self._total += moved
        self._single[memory] = self._single.get(memory, 0.0) + moved
