"""The weight updates that one outcome causes, in a fixed order (paper 5.3).

First the new memory, from w = 0.5; then, by rank, the exemplars in the prompt that the planner followed; then the
Gaussian neighbourhood of the new memory. Other exemplars and warnings in the prompt are not updated, because the
contract does not follow them. The order matters: updates do not commute.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from dualbrain.memory.learning.trust import InfluenceBudget, TrustConfig
from dualbrain.memory.ledger.events import NeighbourUpdates, WeightUpdate
from dualbrain.memory.plasticity.affine_map import AffineMap
from dualbrain.memory.plasticity.hebbian_update import Plasticity
from dualbrain.memory.state.state import LedgerState, day_of


@dataclass(frozen=True, slots=True, kw_only=True)
class OutcomeEvidence:
    """One outcome and the memories it updates: episode `cause` of `source` with label `r` and `Delta`.

    `followed` are rank and id of the exemplars that the contract follows, in the order of the prompt. `neighbours` are
    id and squared distance ‖e_j − e_i‖² of the memories around the episode, nearest first.
    """

    cause: str
    source: str
    r: int
    Delta: float | None
    followed: Sequence[tuple[int, str]]
    neighbours: Sequence[tuple[str, float]]


class WeightUpdater:
    """Computes the weight updates of outcomes that are stored together; each starts from the weights before it."""

    def __init__(self, state: LedgerState, rule: Plasticity, trust: TrustConfig, now: float) -> None:
        """Start from the weights in `state` at `now` [s, 1970 UTC]."""
        self._state, self._rule, self._trust, self._day = state, rule, trust, day_of(now)
        self._updated_weights: dict[str, float] = {}
        self._budgets: dict[str, InfluenceBudget] = {}

    def add_memory(self, name: str, w0: float) -> None:
        """Add a memory that is not in the state yet, with its initial weight."""
        self._updated_weights[name] = w0

    def update(self, evidence: OutcomeEvidence) -> tuple[list[WeightUpdate], NeighbourUpdates | None]:
        """All weight updates of one outcome, in their order."""
        rule = self._rule
        full_update = rule.update_map(evidence.r, evidence.Delta)
        up = rule.is_reinforcing(evidence.r, evidence.Delta)
        budget = self._budgets.setdefault(
            evidence.source, InfluenceBudget(self._state.influence, self._day, evidence.source)
        )
        updates = list[WeightUpdate]()
        for rank, name in ((0, evidence.cause), *evidence.followed):
            w = self._weight(name)
            update, share = (
                self._trust.limit_update(full_update, w, budget.accumulated_change(name))
                if rank
                else (full_update, 1.0)
            )
            after = self._apply_update(name, update, budget if rank else None)
            updates.append(
                WeightUpdate(
                    cause=evidence.cause,
                    memory=name,
                    rule="reinforce" if up else "suppress",
                    rank=rank,
                    gain=update.gain,
                    offset=update.offset,
                    before=w,
                    after=after,
                    share=share,
                )
            )
        return updates, self._update_neighbours(evidence, budget, up=up)

    def _update_neighbours(
        self, evidence: OutcomeEvidence, budget: InfluenceBudget, *, up: bool
    ) -> NeighbourUpdates | None:
        """Update w_j ← clip(w_j + κ ξ exp(−‖e_j − e_i‖²/2ℓ²)), ξ = ±1, j ≠ i; unchanged weights are left out."""
        names, offsets = list[str](), list[float]()
        for name, distance in evidence.neighbours:
            w, offset = self._weight(name), self._rule.neighbour_offset(distance, up=up)
            update, _ = self._trust.limit_update(AffineMap(1.0, offset), w, budget.accumulated_change(name))
            if self._apply_update(name, update, budget) != w:
                names.append(name)
                offsets.append(update.offset)
        rule_name = "reinforce" if up else "suppress"
        return NeighbourUpdates(evidence.cause, rule_name, tuple(names), tuple(offsets)) if names else None

    def _weight(self, name: str) -> float:
        return self._updated_weights[name] if name in self._updated_weights else self._state[name].weight

    def _apply_update(self, name: str, update: AffineMap, budget: InfluenceBudget | None) -> float:
        before = self._weight(name)
        after = self._updated_weights[name] = update(before)
        if budget:
            budget.add(name, abs(after - before))
        return after
