"""Capabilities: the skills of a principal, bounds narrower than the registry's, a rate and an expiry.

    a ∧ b = (the intersection of the skills and of every interval, the lower rate, the earlier expiry)

A capability is only ever delegated by ∧, which is commutative, associative and idempotent, and never allows anything
that either side refuses.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import inf

import msgspec

from dualbrain.contracts.contract import Contract
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.verdict import Rejected

Interval = tuple[float, float]


class Capability(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Authority of a principal over the robot.

    `bounds` narrows numbers by "skill.parameter"; `rate` is in contracts per minute; valid until `expires` [s] in the
    robot's time.
    """

    skills: frozenset[str]
    bounds: dict[str, Interval] = {}
    rate: float = 60.0
    expires: float = inf

    def intersect(self, other: Capability) -> Capability:
        """The capability that both allow; an empty interval allows no number."""
        names = {*self.bounds, *other.bounds}
        return Capability(
            self.skills & other.skills,
            {
                name: _intersect_intervals(self.bounds.get(name, UNBOUNDED), other.bounds.get(name, UNBOUNDED))
                for name in names
            },
            min(self.rate, other.rate),
            min(self.expires, other.expires),
        )

    def check_bounds(self, contract: Contract) -> Rejected | None:
        """The rejection of the first number of `contract` outside these bounds; None if there is none.

        The gate's authorization stage checks the skills.
        """
        for index, action in enumerate(contract.action_sequence):
            for name, value in action.params.items():
                low, high = self.bounds.get(f"{action.skill}.{name}", UNBOUNDED)
                if isinstance(value, float) and not low <= value <= high:
                    pointer = f"/action_sequence/{index}/params/{name}"
                    hint = "outside what this principal was granted"
                    return Rejected(
                        stage="envelope", pointer=pointer, got=value, allowed={"lower": low, "upper": high}, hint=hint
                    )
        return None


UNBOUNDED: Interval = (-inf, inf)


def _intersect_intervals(one: Interval, other: Interval) -> Interval:
    return (max(one[0], other[0]), min(one[1], other[1]))


def full_capability(registry: SkillRegistry) -> Capability:
    """Every registered skill, within the registry's own bounds."""
    return Capability(frozenset(skill.name for skill in registry.skills))


def skill_grants(capabilities: Mapping[str, Capability]) -> dict[str, frozenset[str]]:
    """The grants as the gate's authorization stage reads them."""
    return {principal: capability.skills for principal, capability in capabilities.items()}
