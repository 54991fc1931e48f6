"""move_to: bring the tool, with the held object, above a named object or place."""

from __future__ import annotations

import numpy as np

from dualbrain.contracts.skill_spec import ContactPermit, NameParameter, SkillSpec
from dualbrain.records import FailureCause
from dualbrain.robots.model import RobotModel
from dualbrain.skills import parameters
from dualbrain.skills.arm.controller import ArmController, goal_at_height
from dualbrain.skills.arm.waypoints import follow_waypoints, rise, via_point, wait_for_people
from dualbrain.skills.kinematics import object_geometry
from dualbrain.skills.kinematics.release_point import receiving_point
from dualbrain.skills.skill import SkillResult, SkillRoutine, SkillStatus

TARGET_CLEARANCE = 0.03
"""Clearance between the lowest carried point and the top of the object below it [m]."""


def spec(robot_model: RobotModel) -> SkillSpec:
    """The specification of the skill; a held object may leave its support."""
    return SkillSpec(
        "move_to",
        "bring the hand above an object, container or place, without touching it",
        (
            NameParameter("target", "any", "what to go above"),
            parameters.speed(robot_model),
            parameters.clearance(),
            parameters.route(),
            parameters.wait(),
        ),
        (ContactPermit("rise", "held", "support", parameters.CONTACT_SPEED),),
    )


def routine(arm: ArmController, *, target: str, speed: float, clearance: float, route: str, wait: str) -> SkillRoutine:
    """Wait, rise, cross."""
    support = arm.support
    arm.begin(spec(arm.robot_model), support=support.name if support else None)
    scene = arm.observation.scene
    if target in scene.graspable:
        obj = scene.find(target)
        point = np.array([*obj.pose.position[:2], object_geometry.top_height(obj)])
    else:
        point = receiving_point(scene, target)
    height = max(arm.support_height + clearance, float(point[2]) + TARGET_CLEARANCE) + arm.below_tool
    tool = arm.observation.tool
    end = yield from arm.find_goal(
        np.array([point[0], point[1], height]), _rotation_candidates(tool.rotation, tool.position, point)
    )
    if end is None:
        return SkillResult(SkillStatus.FAILED, f"above {target} is out of reach", FailureCause.OUT_OF_REACH)
    middle = (tool.position + point) / 2
    if wait == "until_clear" and (
        why := (yield from wait_for_people(arm, arm.current_goal(), middle, 4.0, "approach", speed, radius=0.35))
    ):
        return why
    points = [goal_at_height(arm.current_goal(), height)] if tool.position[2] < height - 0.01 else []
    via = via_point(tool.position, end.position, route)
    if via is not None:
        points.append((yield from arm.translate_goal(end, via)))
    if why := (yield from rise(arm, height, speed)):
        return why
    if why := (yield from follow_waypoints(arm, [*points, end], "approach", speed)):
        return why
    return SkillResult(SkillStatus.DONE, f"above {target}")


def _rotation_candidates(rotation: np.ndarray, start: np.ndarray, end: np.ndarray) -> list[np.ndarray]:
    """The current rotation, and the rotation turned with the swing of the arm."""
    swing = float(np.arctan2(end[1], end[0]) - np.arctan2(start[1], start[0]))
    c, s = np.cos(swing), np.sin(swing)
    return [rotation.copy(), np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ rotation]
