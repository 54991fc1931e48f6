"""What one outcome does to weights, in the order that is part of its meaning (paper 5.3).

First the new memory, from w = 0.5; then the exemplars in the prompt that the planner followed, by rank; then the
Gaussian neighbourhood of the new one. What stood beside them is not taught, exemplar or warning: nobody followed it.
Updates do not commute.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from dualbrain.memory.learning.trust import InfluenceBudget, TrustConfig
from dualbrain.memory.ledger.events import NeighbourUpdates, WeightUpdate
from dualbrain.memory.plasticity.affine_map import AffineMap
from dualbrain.memory.plasticity.rule import Plasticity
from dualbrain.memory.state.state import LedgerState, day_of


@dataclass(frozen=True, slots=True, kw_only=True)
class OutcomeEvidence:
    """One outcome and whom it teaches: episode `cause` of `source`, label `r`, `Delta`, the exemplars `followed`.

    These come with their rank, in the order of the prompt. `neighbours` are id and squared distance ‖e_j − e_i‖² of
    those around it, nearest first.
    """

    cause: str
    source: str
    r: int
    Delta: float | None
    followed: Sequence[tuple[int, str]]
    neighbours: Sequence[tuple[str, float]]


class WeightUpdater:
    """Works out the weight events of outcomes that are stored together, each seeing what those before it moved."""

    def __init__(self, state: LedgerState, rule: Plasticity, trust: TrustConfig, now: float) -> None:
        """Begin from `state` at `now` [s, 1970 UTC]."""
        self._state, self._rule, self._trust, self._day = state, rule, trust, day_of(now)
        self._updated_weights: dict[str, float] = {}
        self._budgets: dict[str, InfluenceBudget] = {}

    def add_memory(self, name: str, w0: float) -> None:
        """A memory that the state does not know yet, with its first weight."""
        self._updated_weights[name] = w0

    def update(self, evidence: OutcomeEvidence) -> tuple[list[WeightUpdate], NeighbourUpdates | None]:
        """All weight events of one outcome, in their order."""
        rule = self._rule
        factors, up = rule.update_map(evidence.r, evidence.Delta), rule.is_reinforcing(evidence.r, evidence.Delta)
        word = "reinforce" if up else "suppress"
        account = self._budgets.setdefault(
            evidence.source, InfluenceBudget(self._state.influence, self._day, evidence.source)
        )
        weighings = list[WeightUpdate]()
        for rank, name in ((0, evidence.cause), *evidence.followed):
            w = self._weight(name)
            step, share = (
                self._trust.limit_update(factors, w, account.accumulated_change(name)) if rank else (factors, 1.0)
            )
            after = self._apply_update(name, step, account if rank else None)
            weighings.append(
                WeightUpdate(
                    cause=evidence.cause,
                    memory=name,
                    rule=word,
                    rank=rank,
                    gain=step.gain,
                    offset=step.offset,
                    before=w,
                    after=after,
                    share=share,
                )
            )
        return weighings, self._update_neighbours(evidence, account, up=up)

    def _update_neighbours(
        self, evidence: OutcomeEvidence, account: InfluenceBudget, *, up: bool
    ) -> NeighbourUpdates | None:
        """w_j ← clip(w_j + κ ξ exp(−‖e_j − e_i‖²/2ℓ²)), ξ = ±1, j ≠ i; those that stay are left out."""
        names, offsets = list[str](), list[float]()
        for name, distance in evidence.neighbours:
            w, offset = self._weight(name), self._rule.neighbour_offset(distance, up=up)
            step, _ = self._trust.limit_update(AffineMap(1.0, offset), w, account.accumulated_change(name))
            if self._apply_update(name, step, account) != w:
                names.append(name)
                offsets.append(step.offset)
        word = "reinforce" if up else "suppress"
        return NeighbourUpdates(evidence.cause, word, tuple(names), tuple(offsets)) if names else None

    def _weight(self, name: str) -> float:
        return self._updated_weights[name] if name in self._updated_weights else self._state[name].weight

    def _apply_update(self, name: str, step: AffineMap, account: InfluenceBudget | None) -> float:
        before = self._weight(name)
        after = self._updated_weights[name] = step(before)
        if account:
            account.add(name, abs(after - before))
        return after
