"""push: shove a thing over its support toward a container or place, with closed fingers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.skill_spec import ContactPermit, Name, Number, SkillSpec
from dualbrain.records import SceneObject
from dualbrain.robots.model import Body
from dualbrain.skills import parameters
from dualbrain.skills.arm.controller import Goal, Limb, Part, lifted
from dualbrain.skills.arm.place import spot
from dualbrain.skills.arm.waypoints import GENTLE, arrive, come_down, travel, wait_for_people
from dualbrain.skills.kinematics import object_geometry
from dualbrain.skills.skill import Ending, Status, Story
from dualbrain.skills.time_slicing import Finds, Thought, clearest

Array = NDArray[np.float64]

FARTHEST = 0.25
"""Longest way of one push [m]."""
GAP = 0.035
"""Room between the fingers and the thing before they touch it [m]: margins and the error of its position."""
OFF_FLOOR = 0.012
"""How far the finger tips stay above the support [m]."""
SHUT_FOR = 0.8
"""How long the fingers take to close on nothing [s]."""
BACK = 0.03
"""How far the fingers step back from a pushed thing before they rise [m]."""
BRINK = 0.03
"""Height above the pushing height from which the fingers come down gently [m]."""
ENOUGH = 0.5
"""A push has done its work when the thing went this share of the wanted way."""


def spec(body: Body) -> SkillSpec:
    """The skill's vocabulary entry and the contacts it needs."""
    touch = parameters.CONTACT_SPEED
    distance = Number(
        "distance", "m", 0.03, FARTHEST, "shorter is within the errors of perception",
        "site policy: longer ways are grasped and placed", "how far to push",
    )  # fmt: skip
    return SkillSpec(
        "push",
        "shove an object along the table toward a container or place, with an empty, closed hand",
        (
            Name("object", "graspable", "what to push"),
            Name("destination", "receptive", "what to push it toward"),
            distance,
            parameters.speed(body),
            parameters.clearance(),
            parameters.wait(),
        ),
        (
            ContactPermit("push", "fingers", "target", touch),
            ContactPermit("push", "hand", "target", touch),
            ContactPermit("retreat", "fingers", "target", touch),
            ContactPermit("retreat", "hand", "target", touch),
        ),
    )


def story(
    limb: Limb, *, object: str, destination: str, distance: float, speed: float, clearance: float, wait: str
) -> Story:
    """Tell the push: shut, wait, go behind the thing, come down, push, step back, rise, look."""
    support = limb.support
    limb.begin(spec(limb.body), target=object, support=support.name if support else None)
    if limb.holding:
        return Ending(Status.FAILED, f"already holding {limb.holding.name}")
    thing = limb.see(object)
    way = _way(limb, thing, destination)
    if way is None or float(np.linalg.norm(way)) < distance:
        return Ending(Status.FAILED, f"{destination} is nearer to {object} than the push is long")
    direction = way / np.linalg.norm(way)
    low, _ = yield from clearest(
        _stations(limb, thing, direction, distance), lambda goal, beat: _room(limb, goal, thing, clearance, beat)
    )
    if low is None:
        return Ending(Status.FAILED, f"behind {object} is out of reach")
    yield from _shut(limb)
    above = yield from _above(limb, low, thing, clearance)
    if wait == "until_clear" and (
        why := (yield from wait_for_people(limb, limb.here(), above.position, 4.0, "approach", speed, reach=0.35))
    ):
        return why
    if why := (yield from _go_behind(limb, low, above, speed)):
        return why
    before = np.array(limb.see(object).pose.position)
    end = low.position + (GAP + distance) * np.array([*direction, 0.0])
    goal = yield from limb.shifted(low, end)
    if why := (yield from arrive(limb, goal, "push", GENTLE)):
        return why
    back = limb.here().position - BACK * np.array([*direction, 0.0])
    for position in (back, np.array([back[0], back[1], above.position[2]])):
        goal = yield from limb.shifted(low, position)
        if why := (yield from arrive(limb, goal, "retreat", min(speed, 0.1))):
            return why
    moved = float((np.array(limb.see(object).pose.position) - before)[:2] @ direction)
    words = f"{object} went {moved * 100:.0f} of {distance * 100:.0f} cm toward {destination}"
    return Ending(Status.DONE if moved > ENOUGH * distance else Status.FAILED, words)


def _way(limb: Limb, thing: SceneObject, destination: str) -> Array | None:
    """From the thing to the destination, in the plane (2,) [m]."""
    point, _, _ = spot(limb.senses.scene, destination)
    way = point[:2] - np.array(thing.pose.position[:2])
    return way if float(np.linalg.norm(way)) > 1e-6 else None


def _stations(limb: Limb, thing: SceneObject, direction: Array, distance: float) -> Finds[Goal]:
    """Poses behind the thing from which the whole push is within reach: the fingers' broad side first, then turned."""
    gripper = limb.body.gripper
    height = max(
        object_geometry.bottom(thing) + gripper.pad_below_tool + OFF_FLOOR,
        min(thing.pose.position[2], object_geometry.top(thing) - gripper.pad_below_tool),
    )
    for turn in (0.0, 0.4, -0.4, 0.8, -0.8, 1.57):
        half = (1.0 - abs(np.sin(turn))) * 0.012 + abs(np.sin(turn)) * gripper.finger_thickness
        behind = object_geometry.reach(thing, direction) + half + GAP
        position = np.array([*(np.array(thing.pose.position[:2]) - behind * direction), height])
        forward = object_geometry.about((0.0, 0.0, 1.0), turn) @ np.array([*direction, 0.0])
        across = np.array([-forward[1], forward[0], 0.0])
        goal = yield from limb.goal(
            position, object_geometry.grasp_rotations(across, "top", np.array([*direction, 0.0]))
        )
        if goal is None:
            continue
        end = position + (GAP + distance) * np.array([*direction, 0.0])
        if (yield from limb.kinematics.solve(end, goal.rotation, (goal.posture,))) is not None:
            yield goal


def _above(limb: Limb, low: Goal, thing: SceneObject, clearance: float) -> Thought[Goal]:
    tips = max(limb.floor + clearance, object_geometry.top(thing) + BRINK)
    up = lifted(low, tips + limb.body.gripper.pad_below_tool)
    return limb.shifted(up, up.position)


def _room(limb: Limb, low: Goal, thing: SceneObject, clearance: float, beat: float) -> Thought[float]:
    """Least room [m] on the way down behind the thing."""
    above = yield from _above(limb, low, thing, clearance)
    return (yield from limb.air(above.posture, [low], "descend", 0.0, beat=beat))


def _shut(limb: Limb) -> Part:
    limb.opening, limb.force = 0.0, limb.body.gripper.force_min.value
    yield from limb.stay("shut", SHUT_FOR)
    return None


def _go_behind(limb: Limb, low: Goal, above: Goal, speed: float) -> Part:
    height = float(above.position[2])
    points = [lifted(limb.here(), height)] if limb.senses.tool.position[2] < height - 0.01 else []
    if why := (yield from travel(limb, [*points, above], "approach", speed)):
        return why
    brink = lifted(low, min(height, float(low.position[2]) + BRINK))
    return (yield from come_down(limb, above, brink, low, "descend", min(speed, 0.2), approach="approach"))
