"""What one outcome does to weights, in the order that is part of its meaning (paper 5.3).

First the new memory, from w = 0.5; then the exemplars in the prompt that the planner followed, by rank; then the
Gaussian neighbourhood of the new one. What stood beside them is not taught, exemplar or warning: nobody followed it.
Updates do not commute.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from dualbrain.memory.learning.trust import Account, Trust
from dualbrain.memory.ledger.events import Neighbourhood, Weighing
from dualbrain.memory.plasticity.affine_map import Factors
from dualbrain.memory.plasticity.rule import Plasticity
from dualbrain.memory.state.state import State, day_of


@dataclass(frozen=True, slots=True)
class Lecture:
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


class Teacher:
    """Works out the weight events of outcomes that are stored together, each seeing what those before it moved."""

    def __init__(self, state: State, rule: Plasticity, trust: Trust, now: float) -> None:
        """Begin from `state` at `now` [s, 1970 UTC]."""
        self._state, self._rule, self._trust, self._day = state, rule, trust, day_of(now)
        self._present: dict[str, float] = {}
        self._accounts: dict[str, Account] = {}

    def welcome(self, name: str, w0: float) -> None:
        """A memory that the state does not know yet, with its first weight."""
        self._present[name] = w0

    def teach(self, lecture: Lecture) -> tuple[list[Weighing], Neighbourhood | None]:
        """All weight events of one outcome, in their order."""
        rule = self._rule
        factors, up = rule.factors(lecture.r, lecture.Delta), rule.reinforces(lecture.r, lecture.Delta)
        word = "reinforce" if up else "suppress"
        account = self._accounts.setdefault(
            lecture.source, Account(self._state.influence, self._day, lecture.source)
        )  # fmt: skip
        weighings = list[Weighing]()
        for rank, name in ((0, lecture.cause), *lecture.followed):
            w = self._weight(name)
            step, share = self._trust.bounded(factors, w, account.spent(name)) if rank else (factors, 1.0)
            after = self._move(name, step, account if rank else None)
            weighings.append(Weighing(lecture.cause, name, word, rank, step.gain, step.offset, w, after, share))
        return weighings, self._neighbourhood(lecture, account, up=up)

    def _neighbourhood(self, lecture: Lecture, account: Account, *, up: bool) -> Neighbourhood | None:
        """w_j ← clip(w_j + κ ξ exp(−‖e_j − e_i‖²/2ℓ²)), ξ = ±1, j ≠ i; those that stay are left out."""
        names, offsets = list[str](), list[float]()
        for name, distance in lecture.neighbours:
            w, offset = self._weight(name), self._rule.neighbour_offset(distance, up=up)
            step, _ = self._trust.bounded(Factors(1.0, offset), w, account.spent(name))
            if self._move(name, step, account) != w:
                names.append(name)
                offsets.append(step.offset)
        word = "reinforce" if up else "suppress"
        return Neighbourhood(lecture.cause, word, tuple(names), tuple(offsets)) if names else None

    def _weight(self, name: str) -> float:
        return self._present[name] if name in self._present else self._state[name].weight

    def _move(self, name: str, step: Factors, account: Account | None) -> float:
        before = self._weight(name)
        after = self._present[name] = step(before)
        if account:
            account.add(name, abs(after - before))
        return after
