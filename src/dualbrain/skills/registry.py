"""The skills of a body: the registry they form, and how an action becomes a running skill."""

from __future__ import annotations

from collections.abc import Mapping
from types import ModuleType

from dualbrain.contracts.contract import Value
from dualbrain.contracts.registry import Registry
from dualbrain.robots.mobile_manipulator import arm_of, base_of
from dualbrain.robots.model import Body
from dualbrain.skills import decline
from dualbrain.skills.arm import grasp, hold, home, move_to, place, push, release  # fmt: skip
from dualbrain.skills.arm.controller import Limb
from dualbrain.skills.mobile_base import drive_to, drive_to_pose, stop, turn_to
from dualbrain.skills.mobile_base.controller import Chassis
from dualbrain.skills.mobile_manipulator import Carrier
from dualbrain.skills.skill import Ending, Motion, Nominal, Senses, Story
from dualbrain.skills.time_slicing import glances

ARM: Mapping[str, ModuleType] = {
    "move_to": move_to,
    "grasp": grasp,
    "place": place,
    "push": push,
    "release": release,
    "hold": hold,
    "home": home,
    "decline": decline,
}
"""One module a skill, each with `spec(body)` and `story(limb, **params)`; to add one, write it and name it here."""
BASE: Mapping[str, ModuleType] = {
    "drive_to": drive_to,
    "drive_to_pose": drive_to_pose,
    "turn_to": turn_to,
    "stop": stop,
    "decline": decline,
}
"""The same for a base, whose stories are told with a chassis."""


BOTH: Mapping[str, ModuleType] = {**BASE, **ARM}
"""Those of a mobile manipulator: each is told with the part of the body that it is about."""


def skills_of(body: Body) -> Mapping[str, ModuleType]:
    """The skills that suit `body`."""
    return BOTH if body.carries_arm else BASE if body.mobile else ARM


def limb_of(body: Body, motion: Motion) -> Limb | Chassis | Carrier:
    """What the stories of `body` are told with."""
    if body.carries_arm:
        return Carrier(body, motion)
    return Chassis(body, motion) if body.mobile else Limb(body, motion)


def registry_of(body: Body) -> Registry:
    """The vocabulary P of `body`, bounded by it (paper 3.3)."""
    if not body.mobile:
        return arm_registry(body)
    driving = tuple(module.spec(base_of(body)) for module in BASE.values())
    if not body.carries_arm:
        return Registry(body.name, driving)
    taken = {spec.name for spec in driving}
    reaching = tuple(spec for spec in arm_registry(arm_of(body)).skills if spec.name not in taken)
    return Registry(body.name, (*driving, *reaching))


GRIPPING = ("grasp", "place", "release")
"""Skills that a hand which does not open cannot have."""


def arm_registry(body: Body) -> Registry:
    """The vocabulary P of an arm, bounded by `body` (paper 3.3); an arm without a gripper offers nothing that grips."""
    opens = body.gripper.opening.value > 0.0
    return Registry(body.name, tuple(ARM[name].spec(body) for name in ARM if opens or name not in GRIPPING))


class Running:
    """A skill under way: the map φ of paper 4.2."""

    def __init__(self, limb: Limb | Chassis | Carrier, skill: str, params: Mapping[str, Value]) -> None:
        """Prepare `skill` with its checked parameters; nothing moves before the first `nominal`."""
        self.limb = limb
        teller = limb.work(skill in BASE) if isinstance(limb, Carrier) else limb
        self._story: Story = skills_of(limb.body)[skill].story(teller, **params)
        self._glances = glances(limb.body.period)

    def nominal(self, senses: Senses) -> Nominal | Ending | None:
        """The next tick's intent, or how the skill ended; None while it thinks: then the robot is to rest as it is."""
        self.limb.sense(senses)
        for _ in range(self._glances):
            try:
                nominal = next(self._story)
            except StopIteration as over:
                return over.value
            if nominal is not None:
                return self.limb.whole(nominal) if isinstance(self.limb, Carrier) else nominal
        return None
