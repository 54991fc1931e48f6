"""Against pollution (paper section 8): who is believed at once, and how far one source may move weights in a day."""

from __future__ import annotations

from dataclasses import dataclass

from dualbrain.errors import InvalidSetup
from dualbrain.memory.ledger.events import Status
from dualbrain.memory.plasticity.affine_map import UNCHANGED, Factors
from dualbrain.memory.state.state import Influence
from dualbrain.records import Episode


@dataclass(frozen=True, slots=True)
class Trust:
    """The dials of the defences; `Trust.none()` switches all of them off.

    `quarantine`: a success is a candidate until another of the robot's senses, or a later consistent outcome that is
    believed, confirms it; a verdict that another sense disputes is set aside. `per_source` bounds Σ|Δw| that the
    outcomes of one source cause in one day over all memories, `per_memory` what they cause on one memory.
    `alike` is the least cosine of two situations in which the same contract counts as tried again.
    """

    quarantine: bool = True
    per_source: float = 20.0
    per_memory: float = 1.0
    alike: float = 0.9

    def __post_init__(self) -> None:
        """Raise `InvalidSetup` for bounds that are no bounds."""
        for name, value in (("per_source", self.per_source), ("per_memory", self.per_memory)):
            if not value > 0.0:
                raise InvalidSetup(f"trust {name}", got=value, allowed="above 0")
        if not -1.0 <= self.alike <= 1.0:
            raise InvalidSetup("trust alike", got=self.alike, allowed="in [-1, 1]")

    @classmethod
    def none(cls) -> Trust:
        """No defence at all."""
        return cls(quarantine=False, per_source=float("inf"), per_memory=float("inf"))

    def status(self, episode: Episode) -> Status:
        """The status with which a new memory begins."""
        if not self.quarantine or episode.outcome.kind in ("declined", "aborted", "stopped", "rejected"):
            return "active"
        if episode.second_opinion == "disagrees":
            return "quarantined"
        waits = episode.outcome.kind == "succeeded" and episode.second_opinion != "agrees"
        return "candidate" if waits else "active"

    def bounded(self, factors: Factors, w: float, spent: tuple[float, float]) -> tuple[Factors, float]:
        """The part of a step from `w` that the source may still make, and its share in [0, 1].

        `spent` is Σ|Δw| of the source today: over all memories, and on this one. Promise: no sequence of outcomes
        of one source moves one memory further than `per_memory`, or all together further than `per_source`, in one day.
        """
        wanted = abs(factors.gain * w + factors.offset - w)
        room = min(self.per_source - spent[0], self.per_memory - spent[1])
        if wanted <= room or wanted == 0.0:
            return factors, 1.0
        share = max(0.0, room) / wanted
        return (factors.scaled(share) if share else UNCHANGED), share


class Account:
    """The influence spent today, read from the state, plus what one store is about to spend."""

    def __init__(self, influence: Influence, day: int, source: str) -> None:
        """Begin with what the events say of `source` on `day`."""
        self._influence, self._day, self._source = influence, day, source
        self._total = 0.0
        self._single: dict[str, float] = {}

    def spent(self, memory: str) -> tuple[float, float]:
        """Σ|Δw| of the source today: over all memories, and on `memory`."""
        total, single = self._influence.spent(self._day, self._source, memory)
        return total + self._total, single + self._single.get(memory, 0.0)

    def add(self, memory: str, moved: float) -> None:
        """Count a move."""
        self._total += moved
        self._single[memory] = self._single.get(memory, 0.0) + moved
