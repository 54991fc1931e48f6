"""hold: stand still for a while."""

from __future__ import annotations

from dualbrain.contracts.skill_spec import Number, SkillSpec
from dualbrain.robots.model import Body
from dualbrain.skills.arm.controller import Limb
from dualbrain.skills.skill import Ending, Status, Story


def spec(body: Body) -> SkillSpec:
    """The skill's vocabulary entry."""
    del body
    duration = Number(
        "duration", "s", 0.5, 20.0, "shorter is no pause", "site policy: longer pauses are a new contract", "how long"
    )
    return SkillSpec("hold", "stand still, keeping what is held", (duration,))


def story(limb: Limb, *, duration: float) -> Story:
    """Tell the pause."""
    limb.begin(spec(limb.body))
    yield from limb.stay("hold", duration)
    return Ending(Status.DONE, f"stood still for {duration:g} s")
