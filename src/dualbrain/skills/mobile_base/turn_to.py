"""turn_to: turn the base on the spot to a heading of the map."""

from __future__ import annotations

from math import pi

from dualbrain.contracts.skill_spec import SkillSpec
from dualbrain.robots.model import Body
from dualbrain.skills import parameters
from dualbrain.skills.mobile_base.controller import Chassis
from dualbrain.skills.skill import Ending, Status, Story


def spec(body: Body) -> SkillSpec:
    """The skill's vocabulary entry."""
    return SkillSpec(
        "turn_to",
        "turn on the spot to a heading (0: along the map's x, counter-clockwise)",
        (parameters.heading(), parameters.max_turn_rate(body)),
    )


def story(chassis: Chassis, *, heading: float, max_turn_rate: float) -> Story:
    """Tell the turn."""
    chassis.begin(spec(chassis.body))
    if why := (yield from chassis.turn(heading, max_turn_rate)):
        return why
    return Ending(Status.DONE, f"heading {heading * 180.0 / pi:.0f} degrees")
