"""place: carry the held object to a container or place by the chosen route, lower it, release it, retreat."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.skill_spec import ContactPermit, NameParameter, SkillSpec
from dualbrain.records import FailureCause
from dualbrain.robots.model import RobotModel
from dualbrain.skills import parameters
from dualbrain.skills.arm.controller import (
    RESTING_TOLERANCE,
    YIELDED,
    ArmController,
    SubRoutine,
    ToolGoal,
    goal_at_height,
)
from dualbrain.skills.arm.grasp_planning import order_by_posture_cost, vary_goal
from dualbrain.skills.arm.waypoints import (
    descend,
    follow_waypoints,
    predict_waypoint_clearance,
    reach_goal,
    rise,
    via_point,
    wait_for_people,
)
from dualbrain.skills.kinematics import object_geometry
from dualbrain.skills.kinematics.release_point import ReleasePoint, find_release_point
from dualbrain.skills.skill import SkillResult, SkillRoutine, SkillStatus
from dualbrain.skills.time_slicing import SUFFICIENT_CLEARANCE, SlicedComputation, SlicedIterator, first_clear

Array = NDArray[np.float64]

SLOW_DESCENT_HEIGHT = 0.04
"""Height above the release height from which a load is lowered slowly [m]."""
SET_DOWN_SPEED = 0.015
"""Speed at which a load is lowered onto its support [m/s]: contact with it is felt within 0.2 mm."""
SET_DOWN_TIMEOUT = 0.5
"""Time without progress [s] after which a load that is being lowered onto its support is released where it is."""
MAX_OVERTRAVEL = 0.006
"""Distance [m] by which a load is lowered at most below the perceived height of its support."""
MIN_SUPPORT_FORCE = 1.0
"""Least increase of the upward force on the tool [N] by which the support of a load is felt."""
RETREAT_HEIGHT = 0.08
"""Height by which the open hand rises before the skill ends [m]."""
RELEASE_YAWS = (0.0, 0.4, -0.4, 0.8, -0.8, 1.2, -1.2, 1.57)
"""Alternative rotations about the vertical at the release [rad]."""
RELEASE_ELBOW_SWINGS = (0.0, 0.4, -0.4)
"""Alternative swings of the elbow at the release [rad]."""
MIN_RETREAT_HEIGHT = 0.045
"""Height [m] from which a blocked retreat counts as complete."""


def spec(robot_model: RobotModel) -> SkillSpec:
    """The specification of the skill and its contacts."""
    touch = parameters.CONTACT_SPEED
    return SkillSpec(
        "place",
        "carry what is held to a container or place, put it there and let go",
        (
            NameParameter("destination", "receptive", "where to put it"),
            parameters.speed(robot_model),
            parameters.clearance(),
            parameters.route(),
            parameters.wait(),
        ),
        (
            ContactPermit("rise", "held", "support", touch),
            ContactPermit("lower", "held", "destination", touch),
            ContactPermit("lower", "held", "support", touch),
            ContactPermit("open", "held", "destination", touch),
            ContactPermit("open", "held", "support", touch),
            ContactPermit("open", "fingers", "target", touch),
            ContactPermit("open", "hand", "target", touch),
            ContactPermit("retreat", "fingers", "target", touch),
            ContactPermit("retreat", "hand", "target", touch),
        ),
    )


def routine(
    arm: ArmController, *, destination: str, speed: float, clearance: float, route: str, wait: str
) -> SkillRoutine:
    """Wait, rise, carry, lower, open, retreat, verify."""
    held = arm.holding
    if held is None:
        return SkillResult(SkillStatus.FAILED, "nothing is held", FailureCause.PRECONDITION)
    support = arm.support
    arm.begin(
        spec(arm.robot_model), target=held.name, destination=destination, support=support.name if support else None
    )
    release = find_release_point(arm.observation.scene, destination, held.name)
    release_position = release.position + np.array([0.0, 0.0, held.below_tool])
    height = max(arm.support_height + clearance + held.below_tool, float(release_position[2]) + SLOW_DESCENT_HEIGHT)
    down = yield from _find_release_goal(arm, release_position, height, route, tilt=release.leaning)
    if down is None:
        return SkillResult(SkillStatus.FAILED, f"{destination} is out of reach", FailureCause.OUT_OF_REACH)
    middle = (arm.observation.tool.position + release.position) / 2
    if wait == "until_clear" and (
        why := (yield from wait_for_people(arm, arm.current_goal(), middle, 4.0, "carry", speed, radius=0.35))
    ):
        return why
    above = goal_at_height(down, height)
    way = yield from _waypoints(arm, above, route)
    if why := (yield from rise(arm, height, speed)):
        return why
    why = yield from follow_waypoints(arm, way, "carry", speed, near_suffices=True)
    if why or (why := _check_load_lost(arm, held.name)):
        return why
    slow_from = goal_at_height(down, min(height, float(down.position[2]) + SLOW_DESCENT_HEIGHT))
    while True:
        why = yield from descend(arm, above, slow_from, down, "lower", min(speed, 0.2), wait_phase="carry")
        if why is None and release.surface is not None:
            why = yield from _set_down(arm, down, release.surface)
        if why is not YIELDED:
            break
    if why or (why := _check_load_lost(arm, held.name)):
        return why
    if why := (yield from arm.open_gripper(arm.robot_model.gripper.opening.value)):
        return why
    away = yield from _solve_at_height(arm, down, float(down.position[2]) + RETREAT_HEIGHT)
    why = yield from reach_goal(arm, away, "retreat", speed)
    risen = float(arm.observation.tool.position[2] - down.position[2])
    if why and not (why.status is SkillStatus.TAKEN_OVER and risen > MIN_RETREAT_HEIGHT):
        return why
    return _verify_placement(arm, held.name, destination, release)


def _set_down(arm: ArmController, down: ToolGoal, surface: float) -> SubRoutine:
    """Lower the held load from `down` until its support at height `surface` [m] bears it (a guarded motion).

    With force sensing the load is lowered until the upward force on the tool increases, at most to its perception error
    below the surface. Without, it is released `DROP_HEIGHT` above it. A motion that is blocked has arrived.
    """
    assert arm.holding is not None
    before, depth = arm.tool_force, 0.0
    if before is not None:
        bottom = float(down.position[2]) - arm.below_tool
        depth = bottom - surface + min(arm.find_object(arm.holding.name).error, MAX_OVERTRAVEL)
    lowest = goal_at_height(down, float(down.position[2]) - depth - RESTING_TOLERANCE[0])
    goal = yield from arm.translate_goal(lowest, lowest.position)

    def supported() -> bool:
        force = arm.tool_force
        if before is None or force is None:
            return False
        return force.vector[2] - before.vector[2] > max(MIN_SUPPORT_FORCE, force.uncertainty)

    why = yield from arm.move_tool(goal, "lower", SET_DOWN_SPEED, timeout=SET_DOWN_TIMEOUT, until=supported)
    return None if why and why.status is SkillStatus.TAKEN_OVER else why


def _check_load_lost(arm: ArmController, name: str) -> SkillResult | None:
    """The result for a load that was lost on the way, which the monitor of the load decides."""
    if arm.holding is not None:
        return None
    return SkillResult(SkillStatus.FAILED, f"carry: {name} was lost on the way", FailureCause.LOAD_LOST)


def _find_release_goal(
    arm: ArmController, position: Array, height: float, route: str, *, tilt: bool
) -> SlicedComputation[ToolGoal | None]:
    """The release goal at `position` with most clearance, lowered from tool height `height` [m]; None out of reach."""

    def release_clearance(goal: ToolGoal, threshold: float) -> SlicedComputation[float]:
        """Clearance down and up again, and, if that is clear, on the way there."""
        below = yield from arm.predict_clearance(goal.posture, (), "lower")
        if below <= threshold:
            return below
        above = yield from _solve_at_height(arm, goal, height)
        away = goal_at_height(goal, float(goal.position[2]) + RETREAT_HEIGHT)
        descent = yield from arm.predict_clearance(above.posture, [goal, away], "lower", threshold=threshold)
        if descent < SUFFICIENT_CLEARANCE:
            return descent
        way = yield from _waypoints(arm, goal_at_height(goal, height), route)
        return min(descent, (yield from predict_waypoint_clearance(arm, way, "carry", threshold)))

    candidates = order_by_posture_cost(arm, _release_candidates(arm, position, tilt=tilt))
    best, _ = yield from first_clear(candidates, release_clearance)
    return best


def _release_candidates(arm: ArmController, position: Array, *, tilt: bool) -> SlicedIterator[ToolGoal]:
    """Release goals at `position`: with the current rotation or turned with the swing of the arm, then variations.

    Variations are turned about the vertical, with the elbow swung, and with `tilt` also leaning.
    """
    here = arm.observation.tool
    swing = float(np.arctan2(position[1], position[0]) - np.arctan2(here.position[1], here.position[0]))
    turned = object_geometry.axis_rotation((0.0, 0.0, 1.0), swing) @ here.rotation
    direct = yield from arm.find_goal(position, [here.rotation.copy(), turned])
    if direct is None:
        return
    yield direct
    leans = (0.0, 0.2, -0.2, 0.4, -0.4) if tilt else (0.0,)
    for lean, yaw, elbow in product(leans, RELEASE_YAWS, RELEASE_ELBOW_SWINGS):
        goal = yield from vary_goal(arm, position, direct.rotation, yaw, lean, elbow)
        if goal is not None:
            yield goal


def _solve_at_height(arm: ArmController, goal: ToolGoal, height: float) -> SlicedComputation[ToolGoal]:
    """`goal` at tool height `height` [m], with a new posture if it is within reach."""
    up = goal_at_height(goal, height)
    return arm.translate_goal(up, up.position)


def _waypoints(arm: ArmController, end: ToolGoal, route: str) -> SlicedComputation[list[ToolGoal]]:
    """The waypoints: straight up if necessary, the via point of the route, then above the destination."""
    here = arm.current_goal()
    height = float(end.position[2])
    points = [goal_at_height(here, height)] if here.position[2] < height - 0.01 else []
    via = via_point(here.position, end.position, route)
    if via is not None:
        points.append((yield from arm.translate_goal(end, via)))
    return [*points, end]


def _verify_placement(arm: ArmController, name: str, destination: str, release: ReleasePoint) -> SkillResult:
    """Check that the hand is empty, and by perception that the object is where it was placed."""
    if why := arm.check_release(name):
        return why
    away = float(np.linalg.norm(np.asarray(arm.find_object(name).pose.position)[:2] - release.centre))
    if away > release.radius + arm.find_object(name).error:
        return SkillResult(
            SkillStatus.FAILED,
            f"{name} is {away * 100:.0f} cm from {destination} after letting go",
            FailureCause.GOAL_MISSED,
        )
    return SkillResult(SkillStatus.DONE, f"{name} is at {destination}")
