"""stop: bring the base to rest and stay there for a moment."""

from __future__ import annotations

from dualbrain.contracts.skill_spec import SkillSpec
from dualbrain.robots.model import Body
from dualbrain.skills.mobile_base.controller import Chassis
from dualbrain.skills.skill import Ending, Status, Story

STAY = 0.5
"""[s]"""


def spec(body: Body) -> SkillSpec:
    """The skill's vocabulary entry."""
    del body
    return SkillSpec("stop", "come to rest where you are")


def story(chassis: Chassis) -> Story:
    """Tell the rest."""
    chassis.begin(spec(chassis.body))
    yield from chassis.come_to_rest("stop")
    end = chassis.senses.now + STAY
    while chassis.senses.now < end:
        yield chassis.rest("stop")
    return Ending(Status.DONE, "stands")
