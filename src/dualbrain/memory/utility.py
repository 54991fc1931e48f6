"""Memory Retrieval Utility (paper 7.3): the share of recalled memories that were used, and that helped. It can be zero.

used(i): the contract names the skills of exemplar i in the same order and shares at least one parameter with it
(numbers within 5 %), *and* it is not the contract that was proposed without i. contributing(i): used, and the episode
then succeeds with a Δ no worse than the reference. A planner that would have said the same without memory uses none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from dualbrain.memory.plans import same_plan, same_skills, shares_a_parameter


@dataclass(frozen=True, slots=True)
class Use:
    """What became of one recalled memory: its id, and whether it was used and contributed."""

    memory: str
    used: bool
    contributing: bool


@dataclass(frozen=True, slots=True)
class Utility:
    """Shares over all recalled memories: used, and contributing; None if nothing was recalled."""

    recalled: int
    used: int
    contributing: int

    @property
    def rate(self) -> float | None:
        """Memory Retrieval Utility: contributing over recalled."""
        return self.contributing / self.recalled if self.recalled else None


def was_used(exemplar: dict[str, Any], contract: dict[str, Any] | None, without: dict[str, Any] | None) -> bool:
    """Whether `contract` follows `exemplar` and differs from `without`, the contract proposed when it was left out.

    `without` None: nothing sound was proposed without it, which differs from every contract.
    """
    follows = same_skills(exemplar, contract) and shares_a_parameter(exemplar, contract)
    return follows and not same_plan(contract, without)


def judge(
    memory: str, exemplar: dict[str, Any], contract: dict[str, Any] | None, without: dict[str, Any] | None, *,
    succeeded: bool, Delta: float | None, reference: float | None,
) -> Use:  # fmt: skip
    """What became of one memory. `reference` is the Δ not to be exceeded: that of the exemplar itself (None: any)."""
    used = was_used(exemplar, contract, without)
    no_worse = reference is None or (Delta is not None and Delta <= reference)
    return Use(memory, used, used and succeeded and no_worse)


def total(uses: Sequence[Use]) -> Utility:
    """The shares over many recalls."""
    return Utility(len(uses), sum(use.used for use in uses), sum(use.contributing for use in uses))
