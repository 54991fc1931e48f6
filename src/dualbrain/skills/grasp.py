"""grasp: approach a thing from above or leaning, close on it, feel both fingers, lift it."""

from __future__ import annotations

import numpy as np

from dualbrain.contracts.skill_spec import Choice, ContactPermit, Name, SkillSpec
from dualbrain.embodiment.body import Body
from dualbrain.records import SceneObject
from dualbrain.skills import geometry, parameters
from dualbrain.skills.journey import arrive, come_down, travel, wait_for_people
from dualbrain.skills.limb import Goal, Limb, Part, lifted
from dualbrain.skills.skill import Ending, Status, Story

FINGER_DEPTH = {"top": 0.016, "tilted": 0.008, "side": 0.008}
"""How far below a thing's top the tool may go [m]: the palm, 37 mm above the tool, keeps the filter's margins."""
OVER = 0.04
"""Room between finger tips and the top of a thing when passing over it [m]."""
ENOUGH = 0.011
"""Fingers that reach this far below a thing's top, and are off its middle by less, may close on it [m]."""
BRINK = 0.03
"""Height of the finger tips above a thing's top from which they come down gently [m]."""


def spec(body: Body) -> SkillSpec:
    """The skill's vocabulary entry and the contacts it needs."""
    touch = parameters.CONTACT_SPEED
    return SkillSpec(
        "grasp",
        "approach an object, close the fingers on it and lift it",
        (
            Name("object", "graspable", "what to grasp"),
            parameters.speed(body),
            parameters.clearance(),
            Choice("finger_axis", ("along", "across"), "fingers close along the object's own x (along) or y (across)"),
            parameters.opening(body),
            Choice(
                "approach",
                tuple(geometry.APPROACH_LEAN),
                "top: straight down; tilted: leaning 25 deg; side: leaning 45 deg",
            ),
            parameters.wait(),
            parameters.force(body),
        ),
        (
            ContactPermit("descend", "fingers", "target", touch),
            ContactPermit("close", "fingers", "target", touch),
            ContactPermit("close", "held", "support", touch),
            ContactPermit("lift", "held", "support", touch),
        ),
    )


def grasp_height(body: Body, thing: SceneObject, approach: str) -> float:
    """Tool height [m] that holds `thing` around its middle, not lower than finger tips and palm allow."""
    low = geometry.bottom(thing) + body.gripper.pad_below_tool + 0.008
    middle = thing.pose.position[2]
    return max(low, middle, geometry.top(thing) - FINGER_DEPTH[approach])


def grasp_goal(limb: Limb, thing: SceneObject, finger_axis: str, approach: str) -> Goal | None:
    """The tool pose that grasps `thing`; None when it is out of reach."""
    x, y, _ = thing.pose.position
    position = np.array([x, y, grasp_height(limb.body, thing, approach)])
    outward = np.array([x, y, 0.0]) / (np.hypot(x, y) + 1e-9)
    rotations = geometry.grasp_rotations(geometry.finger_direction(thing, finger_axis), approach, outward)
    return limb.goal(position, rotations)


def story(
    limb: Limb, *, object: str, speed: float, clearance: float, finger_axis: str, opening: float, approach: str,
    wait: str, force: float,
) -> Story:  # fmt: skip
    """Tell the grasp: wait, rise, approach, descend, close, lift."""
    support = limb.support
    limb.begin(spec(limb.body), target=object, support=support.name if support else None)
    thing = limb.see(object)
    if limb.holding:
        return Ending(Status.FAILED, f"already holding {limb.holding.name}")
    at = grasp_goal(limb, thing, finger_axis, approach)
    if at is None:
        return Ending(Status.FAILED, f"{object} is out of reach for a {approach} grasp {finger_axis}")
    limb.opening = opening / 2
    if wait == "until_clear" and (
        why := (yield from wait_for_people(limb, limb.here(), at.position, 4.0, "approach", speed, reach=0.3))
    ):
        return why
    if why := (yield from _come_near(limb, station(limb, at, thing, clearance), speed)):
        return why
    return (yield from _seize(limb, object, at, approach, clearance, speed, force))


def _seize(
    limb: Limb, name: str, at: Goal, approach: str, clearance: float, speed: float, force: float
) -> Story:  # fmt: skip
    """Down, close, up; the thing is looked at again before going down."""
    thing = limb.see(name)
    x, y, _ = thing.pose.position
    at = limb.shifted(at, np.array([x, y, grasp_height(limb.body, thing, approach)]))
    above = station(limb, at, thing, clearance)
    brink = _brink(limb, at, thing)
    why = yield from come_down(limb, above, brink, at, "descend", min(speed, 0.2), approach="approach")
    if why and not (why.status is Status.TAKEN_OVER and _around(limb, thing)):
        return why
    if why := (yield from limb.close(force)):
        return why
    limb.take_hold(thing, float(limb.senses.tool.position[2]) - geometry.bottom(thing))
    up = lifted(at, limb.floor + clearance + limb.below_tool)
    if why := (yield from arrive(limb, limb.shifted(up, up.position), "lift", speed)):
        return why
    if not limb.grips():
        limb.holding = None
        return Ending(Status.FAILED, f"lift: {name} slipped from the fingers")
    return Ending(Status.DONE, f"holds {name}")


def _around(limb: Limb, thing: SceneObject) -> bool:
    """Whether the fingers have enough of `thing` between them to close, though kept from the whole way."""
    tool = limb.senses.tool.position
    off = float(np.hypot(tool[0] - thing.pose.position[0], tool[1] - thing.pose.position[1]))
    deep = geometry.top(thing) - (float(tool[2]) - limb.body.gripper.pad_below_tool)
    return deep > ENOUGH and off < ENOUGH


def station(limb: Limb, at: Goal, thing: SceneObject, clearance: float) -> Goal:
    """The pose from which the fingers come down: straight above the brink, tips clear of the thing's top."""
    tips = max(limb.floor + clearance, geometry.top(thing) + OVER)
    up = lifted(_brink(limb, at, thing), tips + limb.body.gripper.pad_below_tool)
    return limb.shifted(up, up.position)


def _brink(limb: Limb, at: Goal, thing: SceneObject) -> Goal:
    """The pose from which the fingers go on gently, back along the approach axis."""
    return _back(limb, at, geometry.top(thing) + BRINK + limb.body.gripper.pad_below_tool)


def _back(limb: Limb, at: Goal, height: float) -> Goal:
    """`at` moved back along its approach axis until the tool is at `height` [m]."""
    axis = at.rotation[:, 2]
    back = max(0.0, height - float(at.position[2])) / -axis[2]
    return limb.shifted(at, at.position - back * axis)


def _come_near(limb: Limb, above: Goal, speed: float) -> Part:
    """Rise first when below the wanted height, then cross over."""
    height = float(above.position[2])
    if limb.senses.tool.position[2] < height - 0.01 and (
        why := (yield from arrive(limb, lifted(limb.here(), height), "rise", speed))
    ):
        return why
    return (yield from travel(limb, [above], "approach", speed))
