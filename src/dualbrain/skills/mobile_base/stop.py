"""stop: bring the base to rest."""

from __future__ import annotations

from dualbrain.contracts.skill_spec import SkillSpec
from dualbrain.robots.model import RobotModel
from dualbrain.skills.mobile_base.controller import BaseController
from dualbrain.skills.skill import SkillResult, SkillRoutine, SkillStatus

REST_TIME = 0.5
"""Time at rest before the skill ends [s]."""


def spec(robot_model: RobotModel) -> SkillSpec:
    """The specification of the skill."""
    del robot_model
    return SkillSpec("stop", "come to rest where you are")


def routine(base: BaseController) -> SkillRoutine:
    """Brake, then rest for `REST_TIME`."""
    base.begin(spec(base.robot_model))
    yield from base.come_to_rest("stop")
    end = base.observation.now + REST_TIME
    while base.observation.now < end:
        yield base.rest("stop")
    return SkillResult(SkillStatus.DONE, "stands")
