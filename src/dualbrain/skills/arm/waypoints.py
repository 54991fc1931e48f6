"""Motion along waypoints, with repetition after people have passed and with detours when the path is blocked."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from dualbrain.records import FailureCause
from dualbrain.skills.arm.controller import (
    MAX_EVASION_HEIGHT,
    PERSON_CLEARANCE,
    PERSON_WAIT_TIMEOUT,
    YIELDED,
    ArmController,
    SubRoutine,
    ToolGoal,
    goal_at_height,
)
from dualbrain.skills.human_prediction import person_may_reach
from dualbrain.skills.parameters import CONTACT_SPEED
from dualbrain.skills.progress_watchdog import PROGRESS_TIMEOUT
from dualbrain.skills.skill import SkillResult, SkillStatus
from dualbrain.skills.time_slicing import SUFFICIENT_CLEARANCE, SlicedComputation, first_clear

Array = NDArray[np.float64]

DETOUR_TIMEOUT = 1.0
"""Time without progress [s] after which a motion takes a detour, as long as one is left."""
DETOURS = (
    (0.18, "direct"),
    (0.0, "near_base"),
    (0.05, "direct"),
    (0.1, "direct"),
    (0.0, "left"),
    (0.0, "right"),
    (0.05, "near_base"),
    (0.1, "near_base"),
    (0.05, "left"),
    (0.05, "right"),
    (0.1, "left"),
    (0.1, "right"),
)
"""Detours of a blocked motion: rise of the tool [m] and route of the crossing, in the order of preference."""
CONTACT_APPROACH_SPEED = 0.9 * CONTACT_SPEED
"""Speed of the last part of an approach to a contact [m/s]."""


def reach_goal(
    arm: ArmController,
    goal: ToolGoal,
    phase: str,
    speed: float,
    *,
    stop: bool = True,
    timeout: float = PROGRESS_TIMEOUT,
    near_suffices: bool = False,
) -> SubRoutine:
    """Reach `goal`, and try again after each person who passed; `near_suffices` as in `ArmController.move_tool`."""
    while True:
        why = yield from arm.move_tool(goal, phase, speed, stop=stop, timeout=timeout, near_suffices=near_suffices)
        if why is not YIELDED:
            return why


def move_to_height(
    arm: ArmController, height: float, phase: str, speed: float, *, near_suffices: bool = False
) -> SubRoutine:
    """Move vertically to tool height `height` [m]; `near_suffices` as in `ArmController.move_tool`."""
    up = goal_at_height(arm.current_goal(), height)
    goal = yield from arm.translate_goal(up, up.position)
    return (yield from reach_goal(arm, goal, phase, speed, near_suffices=near_suffices))


def rise(arm: ArmController, height: float, speed: float) -> SubRoutine:
    """Pass tool height `height` [m] in the phase "rise", in which a held object may leave its support.

    Nothing moves if the tool is not lower. A rise that is blocked succeeds: the motion that follows takes a detour.
    """
    here = arm.current_goal()
    if here.position[2] >= height - 0.01:
        return None
    up = goal_at_height(here, height)
    why = yield from reach_goal(arm, up, "rise", speed, stop=False, timeout=DETOUR_TIMEOUT)
    return None if why and why.status is SkillStatus.TAKEN_OVER else why


def follow_waypoints(
    arm: ArmController, waypoints: Sequence[ToolGoal], phase: str, speed: float, *, near_suffices: bool = False
) -> SubRoutine:
    """Pass through `waypoints`; if blocked, take the first clear detour, else the one with most clearance.

    With `near_suffices` a motion that is blocked near the last waypoint has reached it.
    """
    start, end, left = arm.observation.tool.position.copy(), waypoints[-1], list(DETOURS)
    why = yield from _follow_once(arm, waypoints, phase, speed, DETOUR_TIMEOUT, near_suffices)
    for timeout in (DETOUR_TIMEOUT, PROGRESS_TIMEOUT):
        if why is None or why.status is not SkillStatus.TAKEN_OVER:
            break
        detour, _ = yield from first_clear(
            left, lambda detour, threshold: _detour_clearance(arm, start, end, detour, phase, threshold)
        )
        detour = detour or left[0]
        left.remove(detour)
        way = yield from _detour_waypoints(arm, start, end, detour)
        why = yield from _follow_once(arm, way, phase, speed, timeout, near_suffices)
    return why


def predict_waypoint_clearance(
    arm: ArmController, waypoints: Sequence[ToolGoal], phase: str, threshold: float
) -> SlicedComputation[float]:
    """Clearance [m] through `waypoints` to the last, or on the best detour; `threshold` as in `predict_clearance`."""
    start, end = arm.observation.tool.position.copy(), waypoints[-1]
    direct = yield from arm.predict_clearance(None, waypoints, phase, threshold=threshold)
    if direct >= SUFFICIENT_CLEARANCE:
        return direct
    _, most = yield from first_clear(
        DETOURS,
        lambda detour, threshold: _detour_clearance(arm, start, end, detour, phase, threshold),
        threshold=max(direct, threshold),
    )
    return most


def descend(
    arm: ArmController,
    above: ToolGoal,
    slow_from: ToolGoal,
    goal: ToolGoal,
    phase: str,
    speed: float,
    *,
    wait_phase: str,
    until: Callable[[], bool] | None = None,
) -> SubRoutine:
    """Descend from `above` while no person will be there: fast to `slow_from`, then slowly to `goal`.

    The slow part is below the permitted contact speed, so that no contact row deflects the path. After a person has
    passed, the descent starts again from above.
    """
    horizon = 2.0 + 2.0 * float(above.position[2] - goal.position[2]) / speed
    while True:
        if why := (yield from wait_for_people(arm, above, goal.position, horizon, wait_phase, speed)):
            return why
        why = yield from arm.move_tool(slow_from, phase, speed)
        if why is None:
            why = yield from arm.move_tool(goal, phase, CONTACT_APPROACH_SPEED, until=until)
        if why is not YIELDED:
            return why


def wait_for_people(
    arm: ArmController,
    wait_goal: ToolGoal,
    spot: Array,
    horizon: float,
    phase: str,
    speed: float,
    *,
    radius: float = PERSON_CLEARANCE,
) -> SubRoutine:
    """Stay at `wait_goal` until no person may come within `radius` [m] of `spot`, from above, in `horizon` [s]."""
    start = arm.observation.active_time
    while True:
        if why := (yield from reach_goal(arm, wait_goal, phase, min(speed, 0.2), near_suffices=True)):
            return why
        if not person_may_reach(arm.observation.scene, spot, horizon, radius, arm.observation.now):
            return None
        while person_may_reach(arm.observation.scene, spot, horizon, radius, arm.observation.now):
            if arm.observation.active_time - start > PERSON_WAIT_TIMEOUT:
                return SkillResult(
                    SkillStatus.FAILED,
                    f"{phase}: a person stayed over the place for {PERSON_WAIT_TIMEOUT:.0f} s",
                    FailureCause.PERSON,
                )
            yield from arm.wait("wait", 0.033)


def _follow_once(
    arm: ArmController,
    waypoints: Sequence[ToolGoal],
    phase: str,
    speed: float,
    timeout: float,
    near_suffices: bool,
) -> SubRoutine:
    for index, point in enumerate(waypoints):
        last = index == len(waypoints) - 1
        if why := (
            yield from reach_goal(
                arm, point, phase, speed, stop=last, timeout=timeout, near_suffices=last and near_suffices
            )
        ):
            return why
    return None


def _detour_clearance(
    arm: ArmController, start: Array, end: ToolGoal, detour: tuple[float, str], phase: str, threshold: float
) -> SlicedComputation[float]:
    way = yield from _detour_waypoints(arm, start, end, detour)
    return (yield from arm.predict_clearance(None, way, phase, threshold=threshold))


def _detour_waypoints(
    arm: ArmController, start: Array, end: ToolGoal, detour: tuple[float, str]
) -> SlicedComputation[list[ToolGoal]]:
    """Waypoints straight up by the rise of the detour, across by its route, and down to the end."""
    rise, route = detour
    here = arm.current_goal()
    height = max(
        float(end.position[2]), min(max(float(here.position[2]), float(end.position[2])) + rise, MAX_EVASION_HEIGHT)
    )
    high = goal_at_height(end, height)
    via = via_point(start, high.position, route)
    points = [goal_at_height(here, height)] if rise else []
    if via is not None:
        points.append((yield from arm.translate_goal(end, via)))
    return [*points, high, end] if rise else [*points, end]


NEAR_BASE_RADIUS = 0.36
"""Distance from the base at which the route "near_base" passes [m]."""
DETOUR_OFFSET = 0.15
"""Lateral offset of the routes "left" and "right" from the straight line [m]."""
VIA_POINT_RADIUS_RANGE = (0.34, 0.68)
"""Range of the distance of a via point from the base [m]."""


def via_point(start: Array, end: Array, route: str) -> Array | None:
    """The point (3,) that `route` passes between `start` and `end`, at the height of `end`; None for "direct"."""
    if route == "direct":
        return None
    middle = (start + end)[:2] / 2
    if route == "near_base":
        via = middle * (NEAR_BASE_RADIUS / (np.linalg.norm(middle) + 1e-9))
    else:
        line = (end - start)[:2]
        left = np.array([-line[1], line[0]]) / (np.linalg.norm(line) + 1e-9)
        via = middle + (DETOUR_OFFSET if route == "left" else -DETOUR_OFFSET) * left
        distance = float(np.linalg.norm(via))
        via = via * (float(np.clip(distance, *VIA_POINT_RADIUS_RANGE)) / (distance + 1e-9))
    return np.array([via[0], via[1], end[2]])
