"""Memory Retrieval Utility (paper 7.3): the share of recalled memories that were used, and that helped. It can be zero.

used(i): the contract names the skills of exemplar i in the same order and shares at least one parameter with it
(numbers within 5 %), *and* the planner's first proposal is not the one it makes without i. contributing(i): used, and
the episode then succeeds with a Δ no worse than the reference. A planner that would have said the same without memory
uses none.
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
    """How many memories stood in prompts that were asked again without them, were used, and contributed."""

    recalled: int
    used: int
    contributing: int

    @property
    def rate(self) -> float | None:
        """Memory Retrieval Utility: contributing over recalled; None if nothing was recalled."""
        return self.contributing / self.recalled if self.recalled else None

    def __str__(self) -> str:
        """One line for a person."""
        return f"of {self.recalled} memories in prompts {self.used} were used, {self.contributing} contributed"


@dataclass(frozen=True, slots=True)
class ExclusionEffect:
    """What leaving one exemplar out of the prompt changes: the first proposal `given` it and the one `without` it.

    None: no contract could be read in that answer, which differs from every contract.
    """

    with_exemplar: RawContract
    without_exemplar: RawContract

    @property
    def is_unchanged(self) -> bool:
        """Whether both say the same plan."""
        return same_plan(self.with_exemplar, self.without_exemplar)


def was_used(exemplar: RawContract, contract: RawContract, effect: ExclusionEffect) -> bool:
    """Whether `contract`, the one that was accepted, follows `exemplar`, and leaving that out changes the proposal."""
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
    """What became of one memory. `reference` is the Δ not to be exceeded: that of the exemplar itself (None: any)."""
    used = was_used(exemplar, contract, effect)
    no_worse = max_Delta is None or (Delta is not None and Delta <= max_Delta)
    return MemoryUse(memory, used, used and succeeded and no_worse)


def summarize_uses(uses: Sequence[MemoryUse]) -> RetrievalUtility:
    """The shares over many recalls."""
    return RetrievalUtility(len(uses), sum(use.used for use in uses), sum(use.contributing for use in uses))
