"""Memory Retrieval Utility (paper 7.3): the share of retrieved memories that were used and contributed to a success.

used(i): the contract names the skills of exemplar i in the same order and shares at least one parameter with it
(numbers within 5 %), *and* the planner's first proposal differs from the one that it makes without i. contributing(i):
used, and the episode then succeeds with a Δ not above the reference. A planner that proposes the same contract without
memory uses no memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from dualbrain.memory.plasticity.plan_similarity import same_plan, same_skills, shares_parameter
from dualbrain.records import MemoryUse

RawContract = dict[str, Any] | None


class RetrievalUtility(msgspec.Struct, frozen=True):
    """Counts of memories: in prompts that were also evaluated without them, used, and contributing."""

    recalled: int
    used: int
    contributing: int

    @property
    def rate(self) -> float | None:
        """Memory Retrieval Utility: contributing / recalled; None if no memory was recalled."""
        return self.contributing / self.recalled if self.recalled else None

    def __str__(self) -> str:
        """One line for people."""
        return f"of {self.recalled} memories in prompts {self.used} were used, {self.contributing} contributed"


@dataclass(frozen=True, slots=True)
class ExclusionEffect:
    """The planner's first proposals with and without one exemplar in the prompt.

    None represents an answer without a readable contract, which differs from every contract.
    """

    with_exemplar: RawContract
    without_exemplar: RawContract

    @property
    def is_unchanged(self) -> bool:
        """Whether both proposals are the same plan."""
        return same_plan(self.with_exemplar, self.without_exemplar)


def was_used(exemplar: RawContract, contract: RawContract, effect: ExclusionEffect) -> bool:
    """Whether the accepted `contract` follows `exemplar`, and the proposal changes without this exemplar."""
    return same_skills(exemplar, contract) and shares_parameter(exemplar, contract) and not effect.is_unchanged


def evaluate_use(
    memory: str,
    exemplar: RawContract,
    contract: RawContract,
    effect: ExclusionEffect,
    *,
    succeeded: bool,
    Delta: float | None,
    max_Delta: float | None,
) -> MemoryUse:
    """Whether one memory was used and contributed.

    `max_Delta`, the Δ of the exemplar, is the largest Δ of a contributing success (None: no bound).
    """
    used = was_used(exemplar, contract, effect)
    no_worse = max_Delta is None or (Delta is not None and Delta <= max_Delta)
    return MemoryUse(memory, used, used and succeeded and no_worse)


def summarize_uses(uses: Sequence[MemoryUse]) -> RetrievalUtility:
    """The counts over many retrieved memories."""
    return RetrievalUtility(len(uses), sum(use.used for use in uses), sum(use.contributing for use in uses))
