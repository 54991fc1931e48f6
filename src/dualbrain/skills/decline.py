"""decline: the planner says that this body cannot or should not do what was asked; nothing moves."""

from __future__ import annotations

from dualbrain.contracts.skill_spec import SkillSpec, Text
from dualbrain.robots.model import Body
from dualbrain.skills.arm.controller import Limb
from dualbrain.skills.skill import Ending, Status, Story


def spec(body: Body) -> SkillSpec:
    """The skill's vocabulary entry."""
    del body
    return SkillSpec("decline", "refuse the instruction, with a reason for people", (Text("reason", 120, "why not"),))


def story(limb: Limb, *, reason: str) -> Story:
    """Tell nothing but the reason."""
    limb.begin(spec(limb.body))
    yield from ()
    return Ending(Status.DONE, f"declined: {reason}")
