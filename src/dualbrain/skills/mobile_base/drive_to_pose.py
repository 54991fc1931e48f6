"""drive_to_pose: bring the base to a point of the map that has no name, and turn it there."""

from __future__ import annotations

from math import pi

import numpy as np

from dualbrain.contracts.skill_spec import Number, SkillSpec
from dualbrain.robots.model import Body
from dualbrain.skills import parameters
from dualbrain.skills.mobile_base.controller import Chassis
from dualbrain.skills.skill import Ending, Status, Story

FAR = 20.0
"""Largest coordinate that may be asked for [m]; the scene's map narrows it further."""


def spec(body: Body) -> SkillSpec:
    """The skill's vocabulary entry."""
    edge = "site policy: the largest map"
    return SkillSpec(
        "drive_to_pose",
        "drive to a point of the map that has no name, and turn there",
        (
            Number("x", "m", -FAR, FAR, edge, edge, "ahead of where the map begins"),
            Number("y", "m", -FAR, FAR, edge, edge, "to the left of it"),
            parameters.heading(),
            parameters.max_speed(body),
            parameters.max_turn_rate(body),
        ),
    )


def story(chassis: Chassis, *, x: float, y: float, heading: float, max_speed: float, max_turn_rate: float) -> Story:
    """Tell the drive and the turn."""
    chassis.begin(spec(chassis.body))
    if why := (yield from chassis.drive(np.array([x, y]), max_speed, max_turn_rate)):
        return why
    if why := (yield from chassis.turn(heading, max_turn_rate)):
        return why
    return Ending(Status.DONE, f"at ({x:.2f}, {y:.2f}), heading {heading * 180.0 / pi:.0f} degrees")
