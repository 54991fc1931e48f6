"""release: open the fingers and retreat."""

from __future__ import annotations

from dualbrain.contracts.skill_spec import ContactPermit, SkillSpec
from dualbrain.robots.model import RobotModel
from dualbrain.skills import parameters
from dualbrain.skills.arm.controller import ArmController
from dualbrain.skills.arm.waypoints import reach_goal
from dualbrain.skills.skill import SkillResult, SkillRoutine, SkillStatus

RETREAT_DISTANCE = 0.08
"""Retreat of the tool along its approach axis [m]."""


def spec(robot_model: RobotModel) -> SkillSpec:
    """The specification of the skill and its contacts."""
    touch = parameters.CONTACT_SPEED
    return SkillSpec(
        "release",
        "open the fingers here and step back",
        (parameters.speed(robot_model),),
        (
            ContactPermit("open", "held", "support", touch),
            ContactPermit("open", "fingers", "target", touch),
            ContactPermit("open", "hand", "target", touch),
            ContactPermit("retreat", "fingers", "target", touch),
            ContactPermit("retreat", "hand", "target", touch),
        ),
    )


def routine(arm: ArmController, *, speed: float) -> SkillRoutine:
    """Open the fingers, then retreat."""
    held, support = arm.holding, arm.support
    arm.begin(spec(arm.robot_model), target=held.name if held else None, support=support.name if support else None)
    if why := (yield from arm.open_gripper(arm.robot_model.gripper.opening.value)):
        return why
    here = arm.current_goal()
    back = yield from arm.translate_goal(here, here.position - RETREAT_DISTANCE * here.rotation[:, 2])
    if why := (yield from reach_goal(arm, back, "retreat", speed)):
        return why
    return SkillResult(SkillStatus.DONE, f"let go of {held.name}" if held else "the hand is open")
