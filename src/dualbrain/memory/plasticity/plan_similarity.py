"""Comparing contracts as plans: skills in order, and parameters up to a tolerance."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, cast

RELATIVE_TOLERANCE = 0.05
"""Numbers within 5 % of each other count as the same."""


def contract_actions(contract: dict[str, Any] | None) -> list[dict[str, Any]]:
    """The actions of a contract; none for what is no contract."""
    found = (contract or {}).get("action_sequence")
    if not isinstance(found, list | tuple):
        return []
    return [cast("dict[str, Any]", action) for action in cast("list[Any]", found) if isinstance(action, dict)]


def same_skills(one: dict[str, Any] | None, other: dict[str, Any] | None) -> bool:
    """Whether both name the same skills in the same order, at least one."""
    a, b = ([action.get("skill") for action in contract_actions(contract)] for contract in (one, other))
    return bool(a) and a == b


def same_plan(one: dict[str, Any] | None, other: dict[str, Any] | None) -> bool:
    """Whether both say the same: skills in order, every word equal, every number within 5 %."""
    return same_skills(one, other) and all(is_close(a, b) for a, b in _parameter_pairs(one, other))


def shares_parameter(one: dict[str, Any] | None, other: dict[str, Any] | None) -> bool:
    """Whether at least one parameter of the same action is equal, or within 5 % if it is a number."""
    return any(is_close(a, b) for a, b in _parameter_pairs(one, other) if a is not None)


def count_differences(one: dict[str, Any] | None, other: dict[str, Any] | None) -> int | None:
    """In how many parameters two plans of the same skills differ; None for plans of other skills."""
    return sum(not is_close(a, b) for a, b in _parameter_pairs(one, other)) if same_skills(one, other) else None


def is_close(one: Any, other: Any) -> bool:
    """Equal, or numbers within 5 % of the larger."""
    if isinstance(one, bool) or isinstance(other, bool):
        return one is other
    if isinstance(one, int | float) and isinstance(other, int | float):
        return math.isclose(one, other, rel_tol=RELATIVE_TOLERANCE, abs_tol=1e-12)
    return one == other


def _parameter_pairs(one: dict[str, Any] | None, other: dict[str, Any] | None) -> Iterator[tuple[Any, Any]]:
    """Values of each parameter that an action of either names; None where one does not."""
    for a, b in zip(contract_actions(one), contract_actions(other), strict=False):
        left, right = _params(a), _params(b)
        for name in sorted({*left, *right}):
            yield left.get(name), right.get(name)


def _params(action: dict[str, Any]) -> dict[str, Any]:
    found = action.get("params")
    return cast("dict[str, Any]", found) if isinstance(found, dict) else {}
