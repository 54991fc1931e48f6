"""grasp: approach an object from above or tilted, close the fingers on it, test both fingers, lift it."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.skill_spec import ChoiceParameter, ContactPermit, NameParameter, SkillSpec
from dualbrain.records import FailureCause, SceneObject
from dualbrain.robots.model import RobotModel
from dualbrain.skills import parameters
from dualbrain.skills.arm.controller import RESTING_TOLERANCE, ArmController, SubRoutine, ToolGoal, goal_at_height
from dualbrain.skills.arm.grasp_planning import (
    alternative_grasps,
    descent_clearance,
    grasp_candidates,
    pregrasp_goal,
    slow_descent_goal,
)
from dualbrain.skills.arm.load_monitor import MAX_CLOSING, MIN_GRIP_FORCE, offset_in_tool
from dualbrain.skills.arm.waypoints import (
    CONTACT_APPROACH_SPEED,
    descend,
    follow_waypoints,
    move_to_height,
    reach_goal,
    wait_for_people,
)
from dualbrain.skills.kinematics import object_geometry
from dualbrain.skills.skill import SkillResult, SkillRoutine, SkillStatus
from dualbrain.skills.time_slicing import SlicedComputation, first_clear

GRIP_FORCE_STEP = 1.5
"""Factor between two grip forces that are tried, from the least force of the gripper to that of the contract."""
GRIP_RESERVE = 1.5
"""Factor of the grip force in motion to that which held in the micro-lift, for the acceleration of the arm.

The grip force is thus at most `GRIP_FORCE_STEP * GRIP_RESERVE` = 2.25 times the least force that holds, or 1.5 times
the least force of the gripper."""
FRAGILE_FRACTION = 0.8
"""Largest grip force on an object, as a fraction of the force that it is declared to bear."""
MICRO_LIFT, MICRO_LIFT_PER_ERROR = 0.004, 1.2
"""Height of the micro-lift [m]: a part for exact perception, and a multiple of the error bound of the object."""
MIN_LIFT = 0.03
"""Height of the load above its support [m] from which a blocked lift counts as complete."""
POSITION_TOLERANCE = RESTING_TOLERANCE[0]
"""Distance from its goal at which a motion of the tool ends [m]."""
MIN_OBSERVATION_TIME, MAX_OBSERVATION_TIME = 0.2, 0.6
"""Time [s] for which the lifted object is observed: at least, and at most if the measurements do not decide."""
CLEAR_RISE_MARGIN = 0.2
"""The rise of the object, as a fraction of the lift, is clear if it is farther than this from one half."""
FORCE_RISE_TIME = 0.1
"""Time [s] in which the fingers reach the force with its reserve."""
FINGER_ROOM = 0.003
"""Room on each side of an object [m], beyond its error bound, to which the fingers close for a descent that fits."""
MAX_DESCENT_FORCE = 5.0
"""Force [N] with which the hand may press on something while it descends; a larger one could tilt an object."""
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
        return SkillResult(SkillStatus.FAILED, f"already holding {arm.holding.name}", FailureCause.PRECONDITION)
    arm.opening = opening / 2
    goal, _ = yield from first_clear(
        grasp_candidates(arm, obj, finger_axis, approach),
        lambda candidate, threshold: descent_clearance(arm, candidate, obj, clearance, threshold),
    )
    if goal is None:
        return SkillResult(
            SkillStatus.FAILED,
            f"{object} is out of reach for a {approach} grasp {finger_axis}",
            FailureCause.OUT_OF_REACH,
        )
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
    why = yield from descend(
        arm, above, low, grasp, "descend", min(speed, 0.2), wait_phase="approach", until=lambda: _presses_down(arm)
    )
    left = float(np.linalg.norm(arm.observation.tool.position - grasp.position))
    if why is None and left > POSITION_TOLERANCE:
        why = SkillResult(
            SkillStatus.TAKEN_OVER,
            f"descend: no progress, the hand presses on something {left * 100:.1f} cm from the goal",
            FailureCause.NO_PROGRESS,
        )
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
    """Rise, and descend again as is predicted to be clear: with another axis or approach, or with the fingers closer.

    The fingers are opened less than specified only if no other descent with the specified opening is clear, and only
    above the object. Without force sensing, fingers that press on something stay where they are: they may have tilted
    it, and it could fall off its support as they rise.
    """
    if arm.observation.contact_force is None and max(arm.observation.state.finger_forces) >= MIN_GRIP_FORCE:
        return blocked
    opening = arm.opening
    goal = yield from _find_clear_descent(
        arm, obj, opening, alternative_grasps(arm, obj, finger_axis, approach), clearance
    )
    if goal is None:
        opening = min(opening, 0.5 * object_geometry.grasp_width(obj, finger_axis) + FINGER_ROOM + obj.error)
        goals = chain(
            grasp_candidates(arm, obj, finger_axis, approach),
            alternative_grasps(arm, obj, finger_axis, approach, opening),
        )
        goal = yield from _find_clear_descent(arm, obj, opening, goals, clearance)
    if goal is None:
        return blocked
    over = yield from pregrasp_goal(arm, goal, obj, clearance)
    if why := (yield from move_to_height(arm, float(over.position[2]), "descend", speed, near_suffices=True)):
        return why
    arm.opening = opening
    return (yield from _descend_to_grasp(arm, obj, goal, clearance, speed))


def _find_clear_descent(
    arm: ArmController, obj: SceneObject, opening: float, goals: Iterable[ToolGoal | None], clearance: float
) -> SlicedComputation[ToolGoal | None]:
    """The goal to which a descent with the fingers at `opening` [m each] is predicted to be clear; None without one."""
    goal, margin = yield from first_clear(
        goals, lambda candidate, threshold: descent_clearance(arm, candidate, obj, clearance, threshold, opening)
    )
    return goal if margin >= 0.0 else None


def _close_and_lift(arm: ArmController, obj: SceneObject, clearance: float, speed: float, force: float) -> SkillRoutine:
    """Close the fingers with the force that holds, and lift the object."""
    name, open_fingers = obj.name, arm.opening
    bound = max_grip_force(arm.robot_model, obj, force)
    why = yield from arm.close_gripper(min(arm.robot_model.gripper.force_min.value, bound))
    if why:
        yield from arm.open_gripper(open_fingers, "close")
        return why
    if why := (yield from _find_holding_force(arm, name, bound, open_fingers)):
        return why
    why = yield from move_to_height(arm, arm.support_height + clearance + arm.below_tool, "lift", speed)
    if why and not (why.status is SkillStatus.TAKEN_OVER and _height_of_load(arm) > MIN_LIFT):
        return why
    return SkillResult(SkillStatus.DONE, f"holds {name}")


def _height_of_load(arm: ArmController) -> float:
    """Height of the lowest point of the held load above the support [m]; 0 without a load."""
    return float(arm.observation.tool.position[2]) - arm.below_tool - arm.support_height if arm.holding else 0.0


def max_grip_force(robot_model: RobotModel, obj: SceneObject, force: float) -> float:
    """Largest force on each finger [N]: that of the contract, and less if `obj` is declared to bear less."""
    if obj.fragile_limit is None:
        return force
    return min(force, max(FRAGILE_FRACTION * obj.fragile_limit, robot_model.gripper.force_min.value))


def _find_holding_force(arm: ArmController, name: str, bound: float, open_fingers: float) -> SubRoutine:
    """Increase the grip force from the least one until a micro-lift shows no slip; then add the reserve.

    The fingers press on the object at the beginning. If it slips at `bound` [N], the hand opens, and the routine fails.
    """
    low = float(arm.observation.tool.position[2])
    while True:
        gripped_at = arm.observation.state.opening
        if why := (yield from _micro_lift(arm, name)):
            return why
        force = arm.force
        if arm.holding:
            arm.force = min(bound, GRIP_RESERVE * force)
            return (yield from arm.wait("lift", FORCE_RISE_TIME))
        if why := (yield from _return_to_grasp(arm, low, gripped_at, open_fingers)):
            return why
        if force >= bound:
            break
        if why := (yield from arm.close_gripper(min(bound, GRIP_FORCE_STEP * force))):
            yield from arm.open_gripper(open_fingers, "close")
            return why
    yield from arm.open_gripper(open_fingers, "close")
    return SkillResult(
        SkillStatus.FAILED,
        f"lift: {name} slips out of the fingers at {bound:.0f} N, the largest force allowed for it",
        FailureCause.NOT_GRIPPED,
    )


def _return_to_grasp(arm: ArmController, low: float, gripped_at: float | None, open_fingers: float) -> SubRoutine:
    """Go down to the tool height `low` [m], with the object between the fingers, after it slipped.

    Fingers that have slid off the object and closed above it open first, else they would push it onto its support.
    Fingers that still press go down as they are: if the object did rise, it is put back and not dropped.
    """
    opening = arm.observation.state.opening
    closed = opening is not None and gripped_at is not None and opening < gripped_at - MAX_CLOSING
    if closed or not arm.is_gripping():
        yield from arm.open_gripper(open_fingers, "close")
    return (yield from move_to_height(arm, low - POSITION_TOLERANCE, "close", CONTACT_APPROACH_SPEED))


def _micro_lift(arm: ArmController, name: str) -> SubRoutine:
    """Lift a few millimetres; afterwards the object is held and monitored if it rose with the fingers, else not held.

    The lift exceeds the error of perception, which is the only sense that shows an object sliding between parallel
    fingers. If perception loses sight of the object between the fingers, their forces alone decide.
    """
    before = arm.find_object(name)
    start = float(arm.observation.tool.position[2])
    height = before.pose.position[2] - object_geometry.bottom_height(before) + arm.lowest_point(before)
    arm.record_grasp(before)
    goal_height = start + MICRO_LIFT + MICRO_LIFT_PER_ERROR * before.error + POSITION_TOLERANCE
    why = yield from move_to_height(arm, goal_height, "lift", CONTACT_APPROACH_SPEED)
    lift, arrived, seen = float(arm.observation.tool.position[2]) - start, arm.observation.now, 0.0
    began = arm.observation.active_time
    if why and not (why.status is SkillStatus.TAKEN_OVER and lift >= goal_height - start - POSITION_TOLERANCE):
        arm.check_holding()
        return why
    offsets: list[NDArray[np.float64]] = []
    rises: list[float] = []
    while arm.observation.active_time - began < MAX_OBSERVATION_TIME:
        obj, tool = arm.find_object(name), arm.observation.tool
        if obj.stamp > max(seen, arrived):
            seen = obj.stamp
            offsets.append(offset_in_tool(obj, tool.position, tool.rotation))
            rises.append((obj.pose.position[2] - height) / lift)
        clear = len(rises) > 0 and abs(float(np.mean(rises)) - 0.5) > CLEAR_RISE_MARGIN
        if clear and arm.observation.active_time - began > MIN_OBSERVATION_TIME:
            break
        yield arm.rest("lift")
    if arm.is_gripping() and (not rises or float(np.mean(rises)) > 0.5):
        arm.watch_load(arm.find_object(name), np.mean(offsets, axis=0) if offsets else None)
    else:
        arm.holding = None
    return None


def _presses_down(arm: ArmController) -> bool:
    """Whether the descending hand presses on something, by its force sensing."""
    force = arm.tool_force
    return force is not None and force.vector[2] > max(MAX_DESCENT_FORCE, force.uncertainty)


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
    return (yield from follow_waypoints(arm, [above], "approach", speed, near_suffices=True))
