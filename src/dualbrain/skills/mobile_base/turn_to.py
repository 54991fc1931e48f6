"""turn_to: turn the base in place to a heading."""

from __future__ import annotations

from math import pi

from dualbrain.contracts.skill_spec import SkillSpec
from dualbrain.robots.model import RobotModel
from dualbrain.skills import parameters
from dualbrain.skills.mobile_base.controller import BaseController
from dualbrain.skills.skill import SkillResult, SkillRoutine, SkillStatus


def spec(robot_model: RobotModel) -> SkillSpec:
    """The specification of the skill."""
    return SkillSpec(
        "turn_to",
        "turn on the spot to a heading (0: along the map's x, counter-clockwise)",
        (parameters.heading(), parameters.max_turn_rate(robot_model)),
    )


def routine(base: BaseController, *, heading: float, max_turn_rate: float) -> SkillRoutine:
    """Turn to `heading` [rad]."""
    base.begin(spec(base.robot_model))
    if why := (yield from base.turn(heading, max_turn_rate)):
        return why
    return SkillResult(SkillStatus.DONE, f"heading {heading * 180.0 / pi:.0f} degrees")
