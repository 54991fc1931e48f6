"""drive_to: bring the base to a named place."""

from __future__ import annotations

import numpy as np

from dualbrain.contracts.skill_spec import Name, SkillSpec
from dualbrain.robots.model import Body
from dualbrain.skills import parameters
from dualbrain.skills.mobile_base.controller import Chassis
from dualbrain.skills.skill import Ending, Status, Story

NEAR = 0.15
"""Within this distance of a place the base says that it has arrived [m]."""


def spec(body: Body) -> SkillSpec:
    """The skill's vocabulary entry."""
    return SkillSpec(
        "drive_to",
        "drive to a named place and stop there",
        (Name("place", "receptive", "where to go"), parameters.max_speed(body), parameters.max_turn_rate(body)),
    )


def story(chassis: Chassis, *, place: str, max_speed: float, max_turn_rate: float) -> Story:
    """Tell the drive, and look where it ended."""
    chassis.begin(spec(chassis.body))
    spot = next((np.array(one.position[:2]) for one in chassis.senses.scene.places if one.name == place), None)
    if spot is None:
        return Ending(Status.FAILED, f"{place} is no place on the map")
    if why := (yield from chassis.drive(spot, max_speed, max_turn_rate)):
        return why
    away = float(np.linalg.norm(chassis.pose[0] - spot))
    if away > NEAR:
        return Ending(Status.FAILED, f"{away * 100:.0f} cm from {place} after the drive")
    return Ending(Status.DONE, f"at {place}")
