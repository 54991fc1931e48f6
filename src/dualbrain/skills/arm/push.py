"""push: move an object over its support toward a container or place, with closed fingers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.skill_spec import ContactPermit, NameParameter, NumberParameter, SkillSpec
from dualbrain.records import FailureCause, SceneObject
from dualbrain.robots.model import RobotModel
from dualbrain.skills import parameters
from dualbrain.skills.arm.controller import YIELDED, ArmController, SubRoutine, ToolGoal, goal_at_height
from dualbrain.skills.arm.waypoints import (
    CONTACT_APPROACH_SPEED,
    descend,
    follow_waypoints,
    wait_for_people,
)
from dualbrain.skills.kinematics import object_geometry
from dualbrain.skills.kinematics.push_room import push_room
from dualbrain.skills.kinematics.release_point import receiving_point
from dualbrain.skills.skill import SkillResult, SkillRoutine, SkillStatus
from dualbrain.skills.time_slicing import SlicedComputation, SlicedIterator, first_clear

Array = NDArray[np.float64]

MAX_PUSH_DISTANCE = 0.25
"""Longest distance of one push [m]."""
START_CLEARANCE = 0.035
"""Distance between the fingers and the object before contact [m]: margins and the error of its position."""
TIP_CLEARANCE = 0.012
"""Height of the finger tips above the support [m]."""
CLOSE_TIME = 0.8
"""Time in which the fingers close without an object [s]."""
RETREAT_DISTANCE = 0.03
"""Retreat of the fingers from a pushed object before they rise [m]."""
SLOW_DESCENT_HEIGHT = 0.03
"""Height above the pushing height from which the fingers descend slowly [m]."""
MIN_PUSH_FRACTION = 0.5
"""Fraction of the distance that the object must move for a successful push."""


def spec(robot_model: RobotModel) -> SkillSpec:
    """The specification of the skill and its contacts."""
    touch = parameters.CONTACT_SPEED
    distance = NumberParameter(
        name="distance",
        unit="m",
        lower=0.03,
        upper=MAX_PUSH_DISTANCE,
        lower_from="shorter is within the errors of perception",
        upper_from="site policy: longer ways are grasped and placed",
        description="how far to push",
    )
    return SkillSpec(
        "push",
        "shove an object along the table toward a container or place, with an empty, closed hand",
        (
            NameParameter("object", "graspable", "what to push"),
            NameParameter("destination", "receptive", "what to push it toward"),
            distance,
            parameters.speed(robot_model),
            parameters.clearance(),
            parameters.wait(),
        ),
        (
            ContactPermit("push", "fingers", "target", touch),
            ContactPermit("push", "hand", "target", touch),
            ContactPermit("retreat", "fingers", "target", touch),
            ContactPermit("retreat", "hand", "target", touch),
        ),
    )


def routine(
    arm: ArmController, *, object: str, destination: str, distance: float, speed: float, clearance: float, wait: str
) -> SkillRoutine:
    """Check the room, close, wait, move behind the object, descend, push, retreat, rise, verify."""
    support = arm.support
    arm.begin(spec(arm.robot_model), target=object, support=support.name if support else None)
    if arm.holding:
        return SkillResult(SkillStatus.FAILED, f"already holding {arm.holding.name}", FailureCause.PRECONDITION)
    obj = arm.find_object(object)
    offset = _push_vector(arm, obj, destination)
    if offset is None or float(np.linalg.norm(offset)) < distance:
        return SkillResult(
            SkillStatus.FAILED, f"{destination} is nearer to {object} than the push is long", FailureCause.PRECONDITION
        )
    direction = offset / np.linalg.norm(offset)
    room = push_room(arm.observation.scene, obj, direction)
    if room.distance < distance:
        return SkillResult(
            SkillStatus.FAILED,
            f"the longest push of {object} toward {destination} is {100.0 * room.distance:.1f} cm: to {room.limit}",
            FailureCause.PRECONDITION,
        )
    low, _ = yield from first_clear(
        _start_candidates(arm, obj, direction, distance),
        lambda goal, threshold: _descent_clearance(arm, goal, obj, clearance, threshold),
    )
    if low is None:
        return SkillResult(SkillStatus.FAILED, f"behind {object} is out of reach", FailureCause.OUT_OF_REACH)
    yield from _close_fingers(arm)
    above = yield from _goal_above(arm, low, obj, clearance)
    if wait == "until_clear" and (
        why := (
            yield from wait_for_people(arm, arm.current_goal(), above.position, 4.0, "approach", speed, radius=0.35)
        )
    ):
        return why
    if why := (yield from _move_behind(arm, low, above, speed)):
        return why
    before = np.array(arm.find_object(object).pose.position)
    end = low.position + (START_CLEARANCE + distance) * np.array([*direction, 0.0])
    goal = yield from arm.translate_goal(low, end)
    why = yield from arm.move_tool(goal, "push", CONTACT_APPROACH_SPEED)
    if why is YIELDED:  # a straight line to the end would lead down onto the object
        reason = f"push: a person is in the way, the hand left {object}"
        return SkillResult(SkillStatus.FAILED, reason, FailureCause.PERSON)
    if why:
        return why
    back = arm.current_goal().position - RETREAT_DISTANCE * np.array([*direction, 0.0])
    for position in (back, np.array([back[0], back[1], above.position[2]])):
        goal = yield from arm.translate_goal(low, position)
        why = yield from arm.move_tool(goal, "retreat", min(speed, 0.1))
        if why is YIELDED:  # the hand is above the object
            break
        if why:
            return why
    moved = float((np.array(arm.find_object(object).pose.position) - before)[:2] @ direction)
    summary = f"{object} went {moved * 100:.0f} of {distance * 100:.0f} cm toward {destination}"
    if moved <= MIN_PUSH_FRACTION * distance:
        return SkillResult(SkillStatus.FAILED, summary, FailureCause.GOAL_MISSED)
    return SkillResult(SkillStatus.DONE, summary)


def _push_vector(arm: ArmController, obj: SceneObject, destination: str) -> Array | None:
    """Vector (2,) [m] from the object to the destination in the plane, or None if they coincide."""
    point = receiving_point(arm.observation.scene, destination)
    offset = point[:2] - np.array(obj.pose.position[:2])
    return offset if float(np.linalg.norm(offset)) > 1e-6 else None


def _start_candidates(
    arm: ArmController, obj: SceneObject, direction: Array, distance: float
) -> SlicedIterator[ToolGoal]:
    """Poses behind the object from which the whole push is within reach: fingers broadside first, then turned."""
    gripper = arm.robot_model.gripper
    height = max(
        object_geometry.bottom_height(obj) + gripper.pad_below_tool + TIP_CLEARANCE,
        min(obj.pose.position[2], object_geometry.top_height(obj) - gripper.pad_below_tool),
    )
    for turn in (0.0, 0.4, -0.4, 0.8, -0.8, 1.57):
        half = (1.0 - abs(np.sin(turn))) * 0.012 + abs(np.sin(turn)) * gripper.finger_thickness
        behind = object_geometry.extent_along(obj, direction) + half + START_CLEARANCE
        position = np.array([*(np.array(obj.pose.position[:2]) - behind * direction), height])
        forward = object_geometry.axis_rotation((0.0, 0.0, 1.0), turn) @ np.array([*direction, 0.0])
        across = np.array([-forward[1], forward[0], 0.0])
        goal = yield from arm.find_goal(
            position, object_geometry.grasp_rotations(across, "top", np.array([*direction, 0.0]))
        )
        if goal is None:
            continue
        end = position + (START_CLEARANCE + distance) * np.array([*direction, 0.0])
        if (yield from arm.kinematics.solve(end, goal.rotation, (goal.posture,))) is not None:
            yield goal


def _goal_above(arm: ArmController, low: ToolGoal, obj: SceneObject, clearance: float) -> SlicedComputation[ToolGoal]:
    tips = max(arm.support_height + clearance, object_geometry.top_height(obj) + SLOW_DESCENT_HEIGHT)
    up = goal_at_height(low, tips + arm.robot_model.gripper.pad_below_tool)
    return arm.translate_goal(up, up.position)


def _descent_clearance(
    arm: ArmController, low: ToolGoal, obj: SceneObject, clearance: float, threshold: float
) -> SlicedComputation[float]:
    """Least clearance [m] of the descent behind the object."""
    above = yield from _goal_above(arm, low, obj, clearance)
    return (yield from arm.predict_clearance(above.posture, [low], "descend", 0.0, threshold=threshold))


def _close_fingers(arm: ArmController) -> SubRoutine:
    arm.opening, arm.force = 0.0, arm.robot_model.gripper.force_min.value
    yield from arm.wait("shut", CLOSE_TIME)
    return None


def _move_behind(arm: ArmController, low: ToolGoal, above: ToolGoal, speed: float) -> SubRoutine:
    height = float(above.position[2])
    points = [goal_at_height(arm.current_goal(), height)] if arm.observation.tool.position[2] < height - 0.01 else []
    if why := (yield from follow_waypoints(arm, [*points, above], "approach", speed)):
        return why
    slow_from = goal_at_height(low, min(height, float(low.position[2]) + SLOW_DESCENT_HEIGHT))
    return (yield from descend(arm, above, slow_from, low, "descend", min(speed, 0.2), wait_phase="approach"))
