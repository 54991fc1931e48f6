"""drive_to: drive the base to a named place."""

from __future__ import annotations

import numpy as np

from dualbrain.contracts.skill_spec import NameParameter, SkillSpec
from dualbrain.records import FailureCause
from dualbrain.robots.model import RobotModel
from dualbrain.skills import parameters
from dualbrain.skills.mobile_base.controller import BaseController
from dualbrain.skills.skill import SkillResult, SkillRoutine, SkillStatus

ARRIVAL_RADIUS = 0.15
"""Distance to the place within which the drive counts as successful [m]."""


def spec(robot_model: RobotModel) -> SkillSpec:
    """The specification of the skill."""
    return SkillSpec(
        "drive_to",
        "drive to a named place and stop there",
        (
            NameParameter("place", "receptive", "where to go"),
            parameters.max_speed(robot_model),
            parameters.max_turn_rate(robot_model),
        ),
    )


def routine(base: BaseController, *, place: str, max_speed: float, max_turn_rate: float) -> SkillRoutine:
    """Drive, and check the final position."""
    base.begin(spec(base.robot_model))
    places = base.observation.scene.places
    spot = next((np.array(entry.position[:2]) for entry in places if entry.name == place), None)
    if spot is None:
        return SkillResult(SkillStatus.FAILED, f"{place} is no place on the map", FailureCause.PRECONDITION)
    if why := (yield from base.drive(spot, max_speed, max_turn_rate)):
        return why
    away = float(np.linalg.norm(base.pose[0] - spot))
    if away > ARRIVAL_RADIUS:
        return SkillResult(
            SkillStatus.FAILED, f"{away * 100:.0f} cm from {place} after the drive", FailureCause.GOAL_MISSED
        )
    return SkillResult(SkillStatus.DONE, f"at {place}")
