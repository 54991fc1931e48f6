"""home: rise above the table and return to the home posture."""

from __future__ import annotations

import numpy as np

from dualbrain.contracts.skill_spec import ContactPermit, SkillSpec
from dualbrain.robots.model import RobotModel
from dualbrain.skills import parameters
from dualbrain.skills.arm.controller import ArmController
from dualbrain.skills.arm.waypoints import move_to_height
from dualbrain.skills.skill import SkillResult, SkillRoutine, SkillStatus

SAFE_HEIGHT = 0.30
"""Tool height above the support from which the posture may change [m]."""
JOINT_SPEED_FRACTION = 0.5
"""Fraction of the joint velocity limits at the largest allowed tool speed."""


def spec(robot_model: RobotModel) -> SkillSpec:
    """The specification of the skill."""
    touch = parameters.CONTACT_SPEED
    return SkillSpec(
        "home",
        "return to the resting posture, keeping what is held",
        (parameters.speed(robot_model),),
        (ContactPermit("rise", "held", "support", touch),),
    )


def routine(arm: ArmController, *, speed: float) -> SkillRoutine:
    """Rise, then move in joint space."""
    support = arm.support
    arm.begin(spec(arm.robot_model), support=support.name if support else None)
    height = arm.support_height + SAFE_HEIGHT
    if arm.observation.tool.position[2] < height and (why := (yield from move_to_height(arm, height, "rise", speed))):
        return why
    share = JOINT_SPEED_FRACTION * speed / arm.robot_model.tool_speed.value
    if why := (yield from arm.move_joints(np.array(arm.robot_model.home), "return", share, speed)):
        return why
    return SkillResult(SkillStatus.DONE, "at home")
