"""A suite with the changes that the command line asks for."""

from __future__ import annotations

from typing import Any

import msgspec

from dualbrain.errors import ConfigurationError, UsageError


def override_suite(suite: str, methods: str, episodes: int, robots: str, planner: str) -> Any:
    """The suite with what the command line changes of it, checked again."""
    from dualbrain.evaluation.planners.factory import check_planners
    from dualbrain.evaluation.protocol.suite import check_suite, load_suite

    found, changes = load_suite(suite), dict[str, Any]()
    if methods:
        changes["methods"] = _split_names("--methods", methods)
    if robots:
        changes |= _restrict_to_robots(found, _split_names("--robots", robots))
    if planner:
        changes["planners"] = found.planners | _parse_planners(planner)
    if episodes < 0:
        raise UsageError("--episodes", got=episodes, allowed="at least 1")
    if episodes:
        seeds = -(-episodes // found.repetitions)
        changes |= {"seeds": seeds, "runs": min(found.runs, seeds)}
    found = msgspec.structs.replace(found, **changes)
    check_suite(found)
    check_planners(found)
    return found


def _split_names(option: str, names: str) -> tuple[str, ...]:
    """Names between commas; raises `WrongUsage` if one of them is empty."""
    found = tuple(name.strip() for name in names.split(","))
    if not all(found):
        raise UsageError(option, got=names, allowed="names with a comma between two of them")
    return found


def _restrict_to_robots(suite: Any, robots: tuple[str, ...]) -> dict[str, Any]:
    """The suite's tasks that one of `robots` can have, for these alone; raises `InvalidSetup` if there are none."""
    alone = msgspec.structs.replace(suite, robots=robots)
    own = (msgspec.structs.replace(one, robots=tuple(r for r in one.robots if r in robots)) for one in suite.tasks)
    kept = [
        new
        for old, new in zip(suite.tasks, own, strict=True)
        if bool(old.robots) == bool(new.robots) and alone.robots_of(new)
    ]
    if not kept:
        have = [f"{task.name}: {', '.join(_possible_robots(task))}" for task in suite.tasks]
        raise ConfigurationError(f"robots of suite {suite.name}", got=", ".join(robots), allowed="; ".join(have))
    return {"robots": robots, "tasks": tuple(kept)}


def _parse_planners(planner: str) -> dict[str, str]:
    """By part: its planner. A name alone is the base. Raises `WrongUsage` if one is missing or a part named twice."""
    pairs = [one.partition("=") for one in _split_names("--planner", planner)]
    named = [(part.strip(), name.strip()) if sign else ("base", part) for part, sign, name in pairs]
    if not all(name for _, name in named) or len(dict(named)) < len(named):
        raise UsageError("--planner", got=planner, allowed="each part once, with its planner, as PART=PLANNER")
    return dict(named)


def _possible_robots(task: Any) -> tuple[str, ...]:
    """The robots that can have `task`: those that it names, or all shipped ones whose family it is of."""
    from dualbrain.robots.loader import BUILTIN_ROBOTS
    from dualbrain.simulation.tasks.families import task_families_for

    return task.robots or tuple(name for name in BUILTIN_ROBOTS if task.family in task_families_for(name))
