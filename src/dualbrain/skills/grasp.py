"""grasp: approach a thing from above or leaning, close on it, feel both fingers, lift it."""

from __future__ import annotations

import numpy as np

from dualbrain.contracts.skill_spec import Choice, ContactPermit, Name, SkillSpec
from dualbrain.embodiment.body import Body
from dualbrain.records import SceneObject
from dualbrain.skills import geometry, parameters
from dualbrain.skills.limb import Goal, Limb, Part, lifted
from dualbrain.skills.skill import Ending, Status, Story

FINGER_DEPTH = 0.035
"""How far the finger tips reach below the palm with a finger's breadth to spare [m]."""
OVER = 0.02
"""Room between finger tips and the top of a thing when passing over it [m]."""


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
            Choice("approach", tuple(geometry.APPROACH_LEAN), "top: straight down; tilted: leaning 25 deg; side: leaning 45 deg"),
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


def grasp_height(body: Body, thing: SceneObject) -> float:
    """Tool height [m] that holds `thing` around its middle: not below the finger tips' room, not deeper than the palm allows."""
    low = geometry.bottom(thing) + body.gripper.pad_below_tool + 0.008
    middle = thing.pose.position[2]
    return max(low, middle, geometry.top(thing) - FINGER_DEPTH)


def grasp_goal(limb: Limb, thing: SceneObject, finger_axis: str, approach: str) -> Goal | None:
    """The tool pose that grasps `thing`; None when it is out of reach."""
    x, y, _ = thing.pose.position
    position = np.array([x, y, grasp_height(limb.body, thing)])
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
    above = _above(limb, at, thing, clearance)
    if wait == "until_clear":
        if why := (yield from limb.wait_for_people("approach", at.position, 4.0, reach=0.30)):
            return why
    if why := (yield from _come_near(limb, above, speed)):
        return why
    if why := (yield from limb.wait_for_people("descend", at.position, 1.5 + 2.0 * (above.position[2] - at.position[2]) / speed)):
        return why
    if why := (yield from limb.reach(at, "descend", min(speed, 0.2))):
        return why
    if why := (yield from limb.close(force)):
        return why
    limb.take_hold(thing, float(limb.senses.tool.position[2]) - geometry.bottom(thing))
    up = lifted(at, limb.floor + clearance + (limb.holding.below_tool if limb.holding else 0.0))
    if why := (yield from limb.reach(limb.shifted(up, up.position), "lift", speed)):
        return why
    if not limb.grips():
        limb.holding = None
        return Ending(Status.FAILED, f"lift: {object} slipped from the fingers")
    return Ending(Status.DONE, f"holds {object}")


def _above(limb: Limb, at: Goal, thing: SceneObject, clearance: float) -> Goal:
    """The pose from which the fingers come down: back along the approach axis, tips clear of the thing's top."""
    tips = max(limb.floor + clearance, geometry.top(thing) + OVER) + limb.body.gripper.pad_below_tool
    axis = at.rotation[:, 2]
    back = max(0.0, tips - at.position[2]) / -axis[2]
    return limb.shifted(at, at.position - back * axis)


def _come_near(limb: Limb, above: Goal, speed: float) -> Part:
    """Rise first when below the wanted height, then cross over."""
    tool = limb.senses.tool
    if tool.position[2] < above.position[2] - 0.01:
        here = Goal(tool.position.copy(), tool.rotation.copy(), limb.senses.state.q)
        if why := (yield from limb.reach(lifted(here, float(above.position[2])), "rise", speed)):
            return why
    return (yield from limb.travel([above], "approach", speed))
