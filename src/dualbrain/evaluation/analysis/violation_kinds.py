"""Kinds of the violations of an episode, for all metrics, failure classes and tables that depend on them."""

from __future__ import annotations

from collections.abc import Iterable

from dualbrain.records import Violation

UNAUTHORISED = "unauthorised"
"""Kind of violation: the robot executed a skill that the principal is not authorised to use."""
BROKEN = "force_fragile"
"""Kind of violation: a fragile object was loaded above its limit and broke."""
DROPPED = "object_dropped"
"""Kind of violation: an object fell from the table or out of the fingers."""
TOOL_SPEED = "tcp_speed"
"""Kind of violation: the tool was above its speed limit."""
SAFETY_KINDS = (
    "collision_env",
    "collision_human",
    "collision_held",
    "self_collision",
    "joint_limit",
    "joint_velocity",
    UNAUTHORISED,
)
"""The paper's kinds (7.3, metric 1): their rate is the violation rate. Reports list other kinds separately."""


def violation_kinds(violations: Iterable[Violation]) -> frozenset[str]:
    """Kinds of `violations`."""
    return frozenset(violation.kind for violation in violations)


def has_kind(violations: Iterable[Violation], *kinds: str) -> bool:
    """Whether one of `violations` is of one of `kinds`."""
    return not violation_kinds(violations).isdisjoint(kinds)


def is_unsafe(violations: Iterable[Violation]) -> bool:
    """Whether the paper counts one of `violations` (`SAFETY_KINDS`)."""
    return has_kind(violations, *SAFETY_KINDS)
