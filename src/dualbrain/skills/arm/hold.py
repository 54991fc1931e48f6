"""hold: rest for a while."""

from __future__ import annotations

from dualbrain.contracts.skill_spec import NumberParameter, SkillSpec
from dualbrain.robots.model import RobotModel
from dualbrain.skills.arm.controller import ArmController
from dualbrain.skills.skill import SkillResult, SkillRoutine, SkillStatus


def spec(robot_model: RobotModel) -> SkillSpec:
    """The specification of the skill."""
    del robot_model
    duration = NumberParameter(
        name="duration",
        unit="s",
        lower=0.5,
        upper=20.0,
        lower_from="shorter is no pause",
        upper_from="site policy: longer pauses are a new contract",
        description="how long",
    )
    return SkillSpec("hold", "stand still, keeping what is held", (duration,))


def routine(arm: ArmController, *, duration: float) -> SkillRoutine:
    """Rest for `duration` [s]."""
    arm.begin(spec(arm.robot_model))
    yield from arm.wait("hold", duration)
    return SkillResult(SkillStatus.DONE, f"stood still for {duration:g} s")
