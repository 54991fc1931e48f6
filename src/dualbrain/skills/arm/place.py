"""place: carry what is held to a container or place by the wanted route, lower it, let go, retreat."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.skill_spec import ContactPermit, Name, SkillSpec
from dualbrain.core.geometry.shapes import Bowl
from dualbrain.records import Scene
from dualbrain.robots.model import Body
from dualbrain.skills import parameters
from dualbrain.skills.arm.controller import Goal, Limb, lifted
from dualbrain.skills.arm.grasp_planning import comfortable_first, posed
from dualbrain.skills.arm.waypoints import arrive, bend, come_down, foreseen, travel, wait_for_people
from dualbrain.skills.kinematics import object_geometry
from dualbrain.skills.skill import Ending, Status, Story
from dualbrain.skills.time_slicing import AIR, Finds, Thought, clearest

Array = NDArray[np.float64]

OVER_RIM = 0.012
"""Room between what is held and the rim when letting go [m]."""
BRINK = 0.04
"""How far above its release height a load is lowered gently [m]."""
AWAY = 0.08
"""How far the open hand rises before the skill ends [m]."""
YAWS = (0.0, 0.4, -0.4, 0.8, -0.8, 1.2, -1.2, 1.57)
"""Turns about the vertical by which a load may be let go otherwise [rad] …"""
ELBOWS = (0.0, 0.4, -0.4)
"""… and swings of the elbow [rad]."""
FREE = 0.045
"""A hand that was kept from rising all the way has let go when it rose this far [m]."""
TOUCH_DOWN = 0.004
"""Height above a support at which a thing is let go [m]."""


def spec(body: Body) -> SkillSpec:
    """The skill's vocabulary entry and the contacts it needs."""
    touch = parameters.CONTACT_SPEED
    return SkillSpec(
        "place",
        "carry what is held to a container or place, put it there and let go",
        (
            Name("destination", "receptive", "where to put it"),
            parameters.speed(body),
            parameters.clearance(),
            parameters.route(),
            parameters.wait(),
        ),
        (
            ContactPermit("rise", "held", "support", touch),
            ContactPermit("lower", "held", "destination", touch),
            ContactPermit("lower", "held", "support", touch),
            ContactPermit("open", "held", "destination", touch),
            ContactPermit("open", "held", "support", touch),
            ContactPermit("open", "fingers", "target", touch),
            ContactPermit("open", "hand", "target", touch),
            ContactPermit("retreat", "fingers", "target", touch),
            ContactPermit("retreat", "hand", "target", touch),
        ),
    )


def spot(scene: Scene, destination: str) -> tuple[Array, float, float]:
    """Where `destination` receives things: position (3,) at its receiving height, radius, drop height [m]."""
    for place in scene.places:
        if place.name == destination:
            return np.asarray(place.position), 0.05, TOUCH_DOWN
    thing = scene.find(destination)
    radius = thing.shape.radius if isinstance(thing.shape, Bowl) else 0.05
    return np.array([*thing.pose.position[:2], object_geometry.top(thing)]), radius, OVER_RIM


def story(limb: Limb, *, destination: str, speed: float, clearance: float, route: str, wait: str) -> Story:
    """Tell the placing: wait, carry, lower, open, retreat, look."""
    held = limb.holding
    if held is None:
        return Ending(Status.FAILED, "nothing is held")
    support = limb.support
    limb.begin(spec(limb.body), target=held.name, destination=destination, support=support.name if support else None)
    point, radius, room = spot(limb.senses.scene, destination)
    spot_down = point + np.array([0.0, 0.0, room + held.below_tool])
    height = max(limb.floor + clearance + held.below_tool, float(spot_down[2]) + BRINK)
    down = yield from _release_goal(limb, spot_down, height, route, tilt=room == OVER_RIM)
    if down is None:
        return Ending(Status.FAILED, f"{destination} is out of reach")
    middle = (limb.senses.tool.position + point) / 2
    if wait == "until_clear" and (
        why := (yield from wait_for_people(limb, limb.here(), middle, 4.0, "carry", speed, reach=0.35))
    ):
        return why
    above = lifted(down, height)
    way = yield from _way(limb, above, route)
    if why := (yield from travel(limb, way, "carry", speed)) or _lost(limb, held.name):
        return why
    brink = lifted(down, min(height, float(down.position[2]) + BRINK))
    why = yield from come_down(limb, above, brink, down, "lower", min(speed, 0.2), approach="carry")
    if why or (why := _lost(limb, held.name)):
        return why
    yield from limb.open(limb.body.gripper.opening.value)
    away = yield from _at(limb, down, float(down.position[2]) + AWAY)
    why = yield from arrive(limb, away, "retreat", speed)
    risen = float(limb.senses.tool.position[2] - down.position[2])
    if why and not (why.status is Status.TAKEN_OVER and risen > FREE):
        return why
    return _look(limb, held.name, destination, point, radius)


def _lost(limb: Limb, name: str) -> Ending | None:
    """Why the load counts as lost, when the fingers no longer feel it; it is an obstacle again from then on."""
    if limb.grips():
        return None
    limb.holding = None
    return Ending(Status.FAILED, f"carry: {name} was lost on the way")


def _release_goal(limb: Limb, position: Array, height: float, route: str, *, tilt: bool) -> Thought[Goal | None]:
    """Where to let go at `position`, lowered from tool height `height` [m]: the clearest way of holding the hand."""

    def air(goal: Goal, beat: float) -> Thought[float]:
        """Down and up again; and, where that is clear, on the way there."""
        below = yield from limb.air(goal.posture, (), "lower")
        if below <= beat:
            return below
        above = yield from _at(limb, goal, height)
        away = lifted(goal, float(goal.position[2]) + AWAY)
        room = yield from limb.air(above.posture, [goal, away], "lower", beat=beat)
        if room < AIR:
            return room
        way = yield from _way(limb, lifted(goal, height), route)
        return min(room, (yield from foreseen(limb, way, "carry", beat)))

    best, _ = yield from clearest(comfortable_first(limb, _release_choices(limb, position, tilt=tilt)), air)
    return best


def _release_choices(limb: Limb, position: Array, *, tilt: bool) -> Finds[Goal]:
    """In the rotation held now, or turned with the arm's own swing when that lies more comfortably; or otherwise.

    Turned about the vertical, the elbow swung, and with `tilt` leaning.
    """
    here = limb.senses.tool
    swing = float(np.arctan2(position[1], position[0]) - np.arctan2(here.position[1], here.position[0]))
    turned = object_geometry.about((0.0, 0.0, 1.0), swing) @ here.rotation
    plain = yield from limb.goal(position, [here.rotation.copy(), turned])
    if plain is None:
        return
    yield plain
    leans = (0.0, 0.2, -0.2, 0.4, -0.4) if tilt else (0.0,)
    for lean, yaw, elbow in product(leans, YAWS, ELBOWS):
        goal = yield from posed(limb, position, plain.rotation, yaw, lean, elbow)
        if goal is not None:
            yield goal


def _at(limb: Limb, goal: Goal, height: float) -> Thought[Goal]:
    """`goal` at tool height `height` [m]."""
    up = lifted(goal, height)
    return limb.shifted(up, up.position)


def _way(limb: Limb, end: Goal, route: str) -> Thought[list[Goal]]:
    """The points to pass: straight up where needed, the route's bend, then above the destination."""
    here = limb.here()
    height = float(end.position[2])
    points = [lifted(here, height)] if here.position[2] < height - 0.01 else []
    via = bend(here.position, end.position, route)
    if via is not None:
        points.append((yield from limb.shifted(end, via)))
    return [*points, end]


def _look(limb: Limb, name: str, destination: str, point: Array, radius: float) -> Ending:
    """The robot's own verdict: is the thing perceived where it was put?"""
    away = float(np.linalg.norm(np.asarray(limb.see(name).pose.position)[:2] - point[:2]))
    if away > radius + limb.see(name).error:
        return Ending(Status.FAILED, f"{name} is {away * 100:.0f} cm from {destination} after letting go")
    return Ending(Status.DONE, f"{name} is at {destination}")
