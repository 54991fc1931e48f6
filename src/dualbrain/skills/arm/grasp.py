"""grasp: approach an object from above or tilted, close the fingers on it, test both fingers, lift it."""

from __future__ import annotations

import numpy as np

from dualbrain.contracts.skill_spec import ChoiceParameter, ContactPermit, NameParameter, SkillSpec
from dualbrain.records import SceneObject
from dualbrain.robots.model import RobotModel
from dualbrain.skills import parameters
from dualbrain.skills.arm.controller import ArmController, SubRoutine, ToolGoal, goal_at_height
from dualbrain.skills.arm.grasp_planning import (
    alternative_grasps,
    descent_clearance,
    grasp_candidates,
    pregrasp_goal,
    slow_descent_goal,
)
from dualbrain.skills.arm.waypoints import descend, follow_waypoints, move_to_height, reach_goal, wait_for_people
from dualbrain.skills.kinematics import object_geometry
from dualbrain.skills.skill import SkillResult, SkillRoutine, SkillStatus
from dualbrain.skills.time_slicing import first_clear

MIN_FINGER_OVERLAP = 0.011
"""Fingers that reach deeper than this below the top of an object, and are off its centre by less, may close [m]."""


def spec(robot_model: RobotModel) -> SkillSpec:
    """The specification of the skill and its contacts."""
    touch = parameters.CONTACT_SPEED
    return SkillSpec(
        "grasp",
        "approach an object, close the fingers on it and lift it",
        (
            NameParameter("object", "graspable", "what to grasp"),
            parameters.speed(robot_model),
            parameters.clearance(),
            ChoiceParameter(
                "finger_axis", ("along", "across"), "fingers close along the object's own x (along) or y (across)"
            ),
            parameters.opening(robot_model),
            ChoiceParameter(
                "approach",
                tuple(object_geometry.APPROACH_LEAN),
                "top: straight down; tilted: leaning 25 deg; side: leaning 45 deg",
            ),
            parameters.wait(),
            parameters.force(robot_model),
        ),
        (
            ContactPermit("descend", "fingers", "target", touch),
            ContactPermit("close", "fingers", "target", touch),
            *([ContactPermit("close", "hand", "target", touch)] if _has_linkage(robot_model) else []),
            ContactPermit("close", "held", "support", touch),
            ContactPermit("lift", "held", "support", touch),
        ),
    )


def _has_linkage(robot_model: RobotModel) -> bool:
    """Whether links of the hand move with the fingers: they approach the target while the fingers close."""
    return any(link.group == "hand" and any(link.slide) for link in robot_model.links)


def routine(
    arm: ArmController,
    *,
    object: str,
    speed: float,
    clearance: float,
    finger_axis: str,
    opening: float,
    approach: str,
    wait: str,
    force: float,
) -> SkillRoutine:
    """Wait, rise, approach, descend, close, lift."""
    support = arm.support
    arm.begin(spec(arm.robot_model), target=object, support=support.name if support else None)
    obj = arm.find_object(object)
    if arm.holding:
        return SkillResult(SkillStatus.FAILED, f"already holding {arm.holding.name}")
    arm.opening = opening / 2
    goal, _ = yield from first_clear(
        grasp_candidates(arm, obj, finger_axis, approach),
        lambda candidate, threshold: descent_clearance(arm, candidate, obj, clearance, threshold),
    )
    if goal is None:
        return SkillResult(SkillStatus.FAILED, f"{object} is out of reach for a {approach} grasp {finger_axis}")
    if wait == "until_clear" and (
        why := (yield from wait_for_people(arm, arm.current_goal(), goal.position, 4.0, "approach", speed, radius=0.3))
    ):
        return why
    why = yield from _descend_to_grasp(arm, obj, goal, clearance, speed)
    if why and why.status is SkillStatus.TAKEN_OVER:
        why = yield from _try_alternative(arm, why, obj, finger_axis, approach, clearance, speed)
    if why:
        return why
    return (yield from _close_and_lift(arm, arm.find_object(object), clearance, speed, force))


def _descend_to_grasp(
    arm: ArmController, obj: SceneObject, grasp: ToolGoal, clearance: float, speed: float
) -> SubRoutine:
    """Move above the object, observe it again, and descend around it; a blocked descent is enough if it can grip."""
    over = yield from pregrasp_goal(arm, grasp, obj, clearance)
    if why := (yield from _approach(arm, over, speed)):
        return why
    now = arm.find_object(obj.name)
    grasp = yield from arm.translate_goal(grasp, grasp.position + np.subtract(now.pose.position, obj.pose.position))
    above = yield from pregrasp_goal(arm, grasp, now, clearance)
    low = yield from slow_descent_goal(arm, grasp, now)
    why = yield from descend(arm, above, low, grasp, "descend", min(speed, 0.2), wait_phase="approach")
    return None if why and why.status is SkillStatus.TAKEN_OVER and _fingers_around(arm, now) else why


def _try_alternative(
    arm: ArmController,
    blocked: SkillResult,
    obj: SceneObject,
    finger_axis: str,
    approach: str,
    clearance: float,
    speed: float,
) -> SubRoutine:
    """Rise, and descend again with the other finger axis or another approach, if that is predicted to be clear."""
    goal, margin = yield from first_clear(
        alternative_grasps(arm, obj, finger_axis, approach),
        lambda candidate, threshold: descent_clearance(arm, candidate, obj, clearance, threshold),
    )
    if goal is None or margin < 0.0:
        return blocked
    over = yield from pregrasp_goal(arm, goal, obj, clearance)
    if why := (yield from move_to_height(arm, float(over.position[2]), "descend", speed)):
        return why
    return (yield from _descend_to_grasp(arm, obj, goal, clearance, speed))


def _close_and_lift(arm: ArmController, obj: SceneObject, clearance: float, speed: float, force: float) -> SkillRoutine:
    """Close the fingers and lift the object."""
    name = obj.name
    if why := (yield from arm.close_gripper(force)):
        return why
    arm.record_grasp(obj)
    if why := (yield from move_to_height(arm, arm.support_height + clearance + arm.below_tool, "lift", speed)):
        return why
    if not arm.is_gripping():
        arm.holding = None
        return SkillResult(SkillStatus.FAILED, f"lift: {name} slipped from the fingers")
    return SkillResult(SkillStatus.DONE, f"holds {name}")


def _fingers_around(arm: ArmController, obj: SceneObject) -> bool:
    """Whether the fingers overlap `obj` enough to close on it, although the descent was blocked."""
    tool = arm.observation.tool.position
    off = float(np.hypot(tool[0] - obj.pose.position[0], tool[1] - obj.pose.position[1]))
    deep = object_geometry.top_height(obj) - (float(tool[2]) - arm.robot_model.gripper.pad_below_tool)
    return deep > MIN_FINGER_OVERLAP and off < MIN_FINGER_OVERLAP


def _approach(arm: ArmController, above: ToolGoal, speed: float) -> SubRoutine:
    """Rise if the tool is below the height of `above`, then cross."""
    height = float(above.position[2])
    if arm.observation.tool.position[2] < height - 0.01 and (
        why := (yield from reach_goal(arm, goal_at_height(arm.current_goal(), height), "rise", speed))
    ):
        return why
    return (yield from follow_waypoints(arm, [above], "approach", speed))
