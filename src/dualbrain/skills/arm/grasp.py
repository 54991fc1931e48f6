"""grasp: approach a thing from above or leaning, close on it, feel both fingers, lift it."""

from __future__ import annotations

import numpy as np

from dualbrain.contracts.skill_spec import Choice, ContactPermit, Name, SkillSpec
from dualbrain.records import SceneObject
from dualbrain.robots.model import Body
from dualbrain.skills import parameters
from dualbrain.skills.arm.controller import Goal, Limb, Part, lifted
from dualbrain.skills.arm.grasp_planning import brink, descent_room, grasp_choices, other_choices, station
from dualbrain.skills.arm.waypoints import arrive, climb, come_down, travel, wait_for_people
from dualbrain.skills.kinematics import object_geometry
from dualbrain.skills.skill import Ending, Status, Story
from dualbrain.skills.time_slicing import clearest

ENOUGH = 0.011
"""Fingers that reach this far below a thing's top, and are off its middle by less, may close on it [m]."""


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
                tuple(object_geometry.APPROACH_LEAN),
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
    limb.opening = opening / 2
    at, _ = yield from clearest(
        grasp_choices(limb, thing, finger_axis, approach),
        lambda at, beat: descent_room(limb, at, thing, clearance, beat),
    )
    if at is None:
        return Ending(Status.FAILED, f"{object} is out of reach for a {approach} grasp {finger_axis}")
    if wait == "until_clear" and (
        why := (yield from wait_for_people(limb, limb.here(), at.position, 4.0, "approach", speed, reach=0.3))
    ):
        return why
    why = yield from _go_down(limb, thing, at, clearance, speed)
    if why and why.status is Status.TAKEN_OVER:
        why = yield from _otherwise(limb, why, thing, finger_axis, approach, clearance, speed)
    if why:
        return why
    return (yield from _seize(limb, limb.see(object), clearance, speed, force))


def _go_down(limb: Limb, thing: SceneObject, at: Goal, clearance: float, speed: float) -> Part:
    """Over the thing and down around it; it is looked at again before going down. Blocked but around it is enough."""
    over = yield from station(limb, at, thing, clearance)
    if why := (yield from _come_near(limb, over, speed)):
        return why
    now = limb.see(thing.name)
    at = yield from limb.shifted(at, at.position + np.subtract(now.pose.position, thing.pose.position))
    above = yield from station(limb, at, now, clearance)
    low = yield from brink(limb, at, now)
    why = yield from come_down(limb, above, low, at, "descend", min(speed, 0.2), approach="approach")
    return None if why and why.status is Status.TAKEN_OVER and _around(limb, now) else why


def _otherwise(
    limb: Limb, blocked: Ending, thing: SceneObject, finger_axis: str, approach: str, clearance: float, speed: float
) -> Part:  # fmt: skip
    """Back up, and down again on the other finger axis or with another approach, if that looks clear."""
    at, room = yield from clearest(
        other_choices(limb, thing, finger_axis, approach),
        lambda at, beat: descent_room(limb, at, thing, clearance, beat),
    )
    if at is None or room < 0.0:
        return blocked
    over = yield from station(limb, at, thing, clearance)
    if why := (yield from climb(limb, float(over.position[2]), "descend", speed)):
        return why
    return (yield from _go_down(limb, thing, at, clearance, speed))


def _seize(limb: Limb, thing: SceneObject, clearance: float, speed: float, force: float) -> Story:
    """Close and lift."""
    name = thing.name
    if why := (yield from limb.close(force)):
        return why
    limb.take_hold(thing)
    if why := (yield from climb(limb, limb.floor + clearance + limb.below_tool, "lift", speed)):
        return why
    if not limb.grips():
        limb.holding = None
        return Ending(Status.FAILED, f"lift: {name} slipped from the fingers")
    return Ending(Status.DONE, f"holds {name}")


def _around(limb: Limb, thing: SceneObject) -> bool:
    """Whether the fingers have enough of `thing` between them to close, though kept from the whole way."""
    tool = limb.senses.tool.position
    off = float(np.hypot(tool[0] - thing.pose.position[0], tool[1] - thing.pose.position[1]))
    deep = object_geometry.top(thing) - (float(tool[2]) - limb.body.gripper.pad_below_tool)
    return deep > ENOUGH and off < ENOUGH


def _come_near(limb: Limb, above: Goal, speed: float) -> Part:
    """Rise first when below the wanted height, then cross over."""
    height = float(above.position[2])
    if limb.senses.tool.position[2] < height - 0.01 and (
        why := (yield from arrive(limb, lifted(limb.here(), height), "rise", speed))
    ):
        return why
    return (yield from travel(limb, [above], "approach", speed))
