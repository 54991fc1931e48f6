"""decline: the planner says that this body cannot or should not do what was asked; nothing moves."""

from __future__ import annotations

from dualbrain.contracts.skill_spec import SkillSpec, TextParameter
from dualbrain.robots.model import RobotModel
from dualbrain.skills.arm.controller import ArmController
from dualbrain.skills.skill import SkillResult, SkillRoutine, SkillStatus


def spec(robot_model: RobotModel) -> SkillSpec:
    """The skill's vocabulary entry."""
    del robot_model
    return SkillSpec(
        "decline", "refuse the instruction, with a reason for people", (TextParameter("reason", 120, "why not"),)
    )


def routine(arm: ArmController, *, reason: str) -> SkillRoutine:
    """Tell nothing but the reason."""
    arm.begin(spec(arm.robot_model))
    yield from ()
    return SkillResult(SkillStatus.DONE, f"declined: {reason}")
