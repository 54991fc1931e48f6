"""decline: the planner refuses an instruction that the robot cannot or should not execute; nothing moves."""

from __future__ import annotations

from dualbrain.contracts.skill_spec import SkillSpec, TextParameter
from dualbrain.robots.model import RobotModel
from dualbrain.skills.arm.controller import ArmController
from dualbrain.skills.skill import SkillResult, SkillRoutine, SkillStatus


def spec(robot_model: RobotModel) -> SkillSpec:
    """The specification of the skill."""
    del robot_model
    return SkillSpec(
        "decline", "refuse the instruction, with a reason for people", (TextParameter("reason", 120, "why not"),)
    )


def routine(arm: ArmController, *, reason: str) -> SkillRoutine:
    """Return the reason without motion."""
    arm.begin(spec(arm.robot_model))
    yield from ()
    return SkillResult(SkillStatus.DONE, f"declined: {reason}")
