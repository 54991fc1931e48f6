"""release: let go here and step back."""

from __future__ import annotations

from dualbrain.contracts.skill_spec import ContactPermit, SkillSpec
from dualbrain.robots.model import Body
from dualbrain.skills import parameters
from dualbrain.skills.arm.controller import Limb
from dualbrain.skills.arm.waypoints import arrive
from dualbrain.skills.skill import Ending, Status, Story

BACK = 0.08
"""How far the tool steps back along its approach axis [m]."""


def spec(body: Body) -> SkillSpec:
    """The skill's vocabulary entry and the contacts it needs."""
    touch = parameters.CONTACT_SPEED
    return SkillSpec(
        "release",
        "open the fingers here and step back",
        (parameters.speed(body),),
        (
            ContactPermit("open", "held", "support", touch),
            ContactPermit("open", "fingers", "target", touch),
            ContactPermit("open", "hand", "target", touch),
            ContactPermit("retreat", "fingers", "target", touch),
            ContactPermit("retreat", "hand", "target", touch),
        ),
    )


def story(limb: Limb, *, speed: float) -> Story:
    """Tell the letting go: open, retreat."""
    held, support = limb.holding, limb.support
    limb.begin(spec(limb.body), target=held.name if held else None, support=support.name if support else None)
    yield from limb.open(limb.body.gripper.opening.value)
    here = limb.here()
    back = yield from limb.shifted(here, here.position - BACK * here.rotation[:, 2])
    if why := (yield from arrive(limb, back, "retreat", speed)):
        return why
    return Ending(Status.DONE, f"let go of {held.name}" if held else "the hand is open")
