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

from dualbrain.memory.plasticity.plan_similarity import same_plan, same_skills, shares_a_parameter
from dualbrain.records import Use

Contract = dict[str, Any] | None


class Utility(msgspec.Struct, frozen=True):
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
class Change:
    """What leaving one exemplar out of the prompt changes: the first proposal `given` it and the one `without` it.

    None: no contract could be read in that answer, which differs from every contract.
    """

    given: Contract
    without: Contract

    @property
    def none(self) -> bool:
        """Whether both say the same plan."""
        return same_plan(self.given, self.without)


def was_used(exemplar: Contract, contract: Contract, change: Change) -> bool:
    """Whether `contract`, the one that was accepted, follows `exemplar`, and leaving that out changes the proposal."""
    return same_skills(exemplar, contract) and shares_a_parameter(exemplar, contract) and not change.none


def judge(
    memory: str, exemplar: Contract, contract: Contract, change: Change, *, succeeded: bool, Delta: float | None,
    reference: float | None,
) -> Use:  # fmt: skip
    """What became of one memory. `reference` is the Δ not to be exceeded: that of the exemplar itself (None: any)."""
    used = was_used(exemplar, contract, change)
    no_worse = reference is None or (Delta is not None and Delta <= reference)
    return Use(memory, used, used and succeeded and no_worse)


def total(uses: Sequence[Use]) -> Utility:
    """The shares over many recalls."""
    return Utility(len(uses), sum(use.used for use in uses), sum(use.contributing for use in uses))
