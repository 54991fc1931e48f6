"""Changes of a suite by command-line options."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import msgspec

from dualbrain.errors import ConfigurationError, UsageError

if TYPE_CHECKING:
    from dualbrain.evaluation.protocol.suite import Suite, Task


def override_suite(
    suite: str,
    methods: str,
    episodes: int,
    robots: str,
    planner: str,
    *,
    target: str = "",
    on_left_out: Callable[[tuple[str, ...]], None] | None = None,
) -> Suite:
    """The suite `suite` with the options applied, validated again; an empty option changes nothing.

    With `on_left_out`, methods for whose role the suite names no planner are left out and reported to it.

    Raises:
        UsageError: an option is malformed.
        ConfigurationError: the resulting suite is not valid.
        UnknownNameError: a suite, method, robot or planner is not known.
    """
    from dualbrain.evaluation.planners.factory import check_planners
    from dualbrain.evaluation.protocol.suite import check_suite, load_suite

    found, changes = load_suite(suite), dict[str, Any]()
    if methods:
        changes["methods"] = _split_names("--methods", methods)
    if robots:
        changes |= _restrict_to_robots(found, _split_names("--robots", robots))
    if planner:
        changes["planners"] = found.planners | _parse_planners(planner)
    if target:
        changes["target"] = target
    if episodes < 0:
        raise UsageError("--episodes", got=episodes, allowed="at least 1")
    if episodes:
        seeds = -(-episodes // found.repetitions)
        changes |= {"seeds": seeds, "runs": min(found.runs, seeds)}
    found = msgspec.structs.replace(found, **changes)
    if on_left_out:
        found, left_out = _without_unnamed_planners(found)
        on_left_out(left_out)
    check_suite(found)
    check_planners(found)
    return found


def _without_unnamed_planners(suite: Suite) -> tuple[Suite, tuple[str, ...]]:
    """`suite` without the methods for whose role it names no planner, and the names of these methods."""
    missing = tuple(
        method.name for method in suite.resolved_methods if method.planner_role not in (*suite.planners, "adversary")
    )
    kept = tuple(name for name in suite.methods if name not in missing)
    return (msgspec.structs.replace(suite, methods=kept) if kept else suite), missing


def _split_names(option: str, names: str) -> tuple[str, ...]:
    """Names separated by commas; raises `UsageError` if one of them is empty."""
    found = tuple(name.strip() for name in names.split(","))
    if not all(found):
        raise UsageError(option, got=names, allowed="names separated by commas")
    return found


def _restrict_to_robots(suite: Suite, robots: tuple[str, ...]) -> dict[str, Any]:
    """Fields of the suite with only the tasks that one of `robots` can perform; raises `ConfigurationError` if none."""
    alone = msgspec.structs.replace(suite, robots=robots)
    narrowed = (msgspec.structs.replace(one, robots=tuple(r for r in one.robots if r in robots)) for one in suite.tasks)
    kept = [
        new
        for old, new in zip(suite.tasks, narrowed, strict=True)
        if bool(old.robots) == bool(new.robots) and alone.robots_of(new)
    ]
    if not kept:
        possible = [f"{task.name}: {', '.join(_possible_robots(task))}" for task in suite.tasks]
        raise ConfigurationError(f"robots of suite {suite.name}", got=", ".join(robots), allowed="; ".join(possible))
    return {"robots": robots, "tasks": tuple(kept)}


def _parse_planners(planner: str) -> dict[str, str]:
    """Planner by role; a name without a role is the base planner.

    Raises:
        UsageError: a planner is missing, or a role occurs twice.
    """
    from dualbrain.planner.backends.key_redaction import public_planner

    named = [_parse_role(one) for one in _split_names("--planner", planner)]
    if not all(name for _, name in named) or len(dict(named)) < len(named):
        got = ",".join(f"{role}={public_planner(name)}" for role, name in named)
        raise UsageError("--planner", got=got, allowed="each role once, as ROLE=PLANNER")
    return dict(named)


def _parse_role(planner: str) -> tuple[str, str]:
    """Role and name in ROLE=PLANNER, or the role base; the query of an address contains the sign, too."""
    role, sign, name = planner.partition("=")
    return (role.strip(), name.strip()) if sign and "://" not in role else ("base", planner)


def _possible_robots(task: Task) -> tuple[str, ...]:
    """Robots that can perform `task`: those that it names, or else all built-in robots of its family."""
    from dualbrain.robots.loader import SIMULATED_ROBOTS
    from dualbrain.simulation.tasks.families import task_families_for

    return task.robots or tuple(name for name in SIMULATED_ROBOTS if task.family in task_families_for(name))
