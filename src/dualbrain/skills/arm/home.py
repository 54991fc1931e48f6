"""home: rise clear of the table and return to the resting posture."""

from __future__ import annotations

import numpy as np

from dualbrain.contracts.skill_spec import ContactPermit, SkillSpec
from dualbrain.robots.model import Body
from dualbrain.skills import parameters
from dualbrain.skills.arm.controller import Limb
from dualbrain.skills.arm.waypoints import climb
from dualbrain.skills.skill import Ending, Status, Story

SAFE_HEIGHT = 0.30
"""Tool height from which the posture is changed [m]."""
FULL_SPEED = 0.5
"""Share of the joint velocity limits at the largest allowed tool speed."""


def spec(body: Body) -> SkillSpec:
    """The skill's vocabulary entry."""
    touch = parameters.CONTACT_SPEED
    return SkillSpec(
        "home",
        "return to the resting posture, keeping what is held",
        (parameters.speed(body),),
        (ContactPermit("rise", "held", "support", touch),),
    )


def story(limb: Limb, *, speed: float) -> Story:
    """Tell the return: rise, then move in joint space."""
    support = limb.support
    limb.begin(spec(limb.body), support=support.name if support else None)
    height = limb.floor + SAFE_HEIGHT
    if limb.senses.tool.position[2] < height and (why := (yield from climb(limb, height, "rise", speed))):
        return why
    share = FULL_SPEED * speed / limb.body.tool_speed.value
    if why := (yield from limb.joints(np.array(limb.body.home), "return", share, speed)):
        return why
    return Ending(Status.DONE, "at home")
