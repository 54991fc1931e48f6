"""Comparison of contracts as plans: skills in order, and parameters up to a tolerance."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, cast

RELATIVE_TOLERANCE = 0.05
"""Numbers within 5 % of each other count as the same."""


def contract_actions(contract: dict[str, Any] | None) -> list[dict[str, Any]]:
    """The actions of a contract; an empty list for None and for an object that is not a contract."""
    found = (contract or {}).get("action_sequence")
    if not isinstance(found, list | tuple):
        return []
    return [cast("dict[str, Any]", action) for action in cast("list[Any]", found) if isinstance(action, dict)]


def same_skills(one: dict[str, Any] | None, other: dict[str, Any] | None) -> bool:
    """Whether both contracts name the same skills in the same order, and at least one skill."""
    a, b = ([action.get("skill") for action in contract_actions(contract)] for contract in (one, other))
    return bool(a) and a == b


def same_plan(one: dict[str, Any] | None, other: dict[str, Any] | None) -> bool:
    """Whether both contracts are the same plan: equal skills in order, equal words, numbers within 5 %."""
    return same_skills(one, other) and all(is_close(a, b) for a, b in _parameter_pairs(one, other))


def shares_parameter(one: dict[str, Any] | None, other: dict[str, Any] | None) -> bool:
    """Whether at least one parameter of the same action is equal, or within 5 % if it is a number."""
    return any(is_close(a, b) for a, b in _parameter_pairs(one, other) if a is not None)


def count_differences(one: dict[str, Any] | None, other: dict[str, Any] | None) -> int | None:
    """Number of parameters in which two plans with the same skills differ; None if the skills differ."""
    return sum(not is_close(a, b) for a, b in _parameter_pairs(one, other)) if same_skills(one, other) else None


def is_close(one: Any, other: Any) -> bool:
    """Whether two values are equal, or numbers within 5 % of the larger."""
    if isinstance(one, bool) or isinstance(other, bool):
        return one is other
    if isinstance(one, int | float) and isinstance(other, int | float):
        return math.isclose(one, other, rel_tol=RELATIVE_TOLERANCE, abs_tol=1e-12)
    return one == other


def _parameter_pairs(one: dict[str, Any] | None, other: dict[str, Any] | None) -> Iterator[tuple[Any, Any]]:
    """Both values of each parameter that an action of either contract names; None where a contract lacks it."""
    for a, b in zip(contract_actions(one), contract_actions(other), strict=False):
        left, right = _params(a), _params(b)
        for name in sorted({*left, *right}):
            yield left.get(name), right.get(name)


def _params(action: dict[str, Any]) -> dict[str, Any]:
    found = action.get("params")
    return cast("dict[str, Any]", found) if isinstance(found, dict) else {}
