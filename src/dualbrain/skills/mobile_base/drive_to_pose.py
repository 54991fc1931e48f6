"""drive_to_pose: drive the base to a point of the map without a name, and turn there."""

from __future__ import annotations

from math import pi

import numpy as np

from dualbrain.contracts.skill_spec import NumberParameter, SkillSpec
from dualbrain.robots.model import RobotModel
from dualbrain.skills import parameters
from dualbrain.skills.mobile_base.controller import BaseController
from dualbrain.skills.skill import SkillResult, SkillRoutine, SkillStatus

MAX_COORDINATE = 20.0
"""Largest coordinate of a goal [m]; the map of the scene narrows it further."""


def spec(robot_model: RobotModel) -> SkillSpec:
    """The specification of the skill."""
    edge = "site policy: the largest map"
    return SkillSpec(
        "drive_to_pose",
        "drive to a point of the map that has no name, and turn there",
        (
            NumberParameter(
                name="x",
                unit="m",
                lower=-MAX_COORDINATE,
                upper=MAX_COORDINATE,
                lower_from=edge,
                upper_from=edge,
                description="ahead of where the map begins",
            ),
            NumberParameter(
                name="y",
                unit="m",
                lower=-MAX_COORDINATE,
                upper=MAX_COORDINATE,
                lower_from=edge,
                upper_from=edge,
                description="to the left of it",
            ),
            parameters.heading(),
            parameters.max_speed(robot_model),
            parameters.max_turn_rate(robot_model),
        ),
    )


def routine(
    base: BaseController, *, x: float, y: float, heading: float, max_speed: float, max_turn_rate: float
) -> SkillRoutine:
    """Drive, then turn."""
    base.begin(spec(base.robot_model))
    if why := (yield from base.drive(np.array([x, y]), max_speed, max_turn_rate)):
        return why
    if why := (yield from base.turn(heading, max_turn_rate)):
        return why
    return SkillResult(SkillStatus.DONE, f"at ({x:.2f}, {y:.2f}), heading {heading * 180.0 / pi:.0f} degrees")
