"""move_to: bring the tool (and what it holds) above a named thing or place."""

from __future__ import annotations

import numpy as np

from dualbrain.contracts.skill_spec import ContactPermit, Name, SkillSpec
from dualbrain.robots.model import Body
from dualbrain.skills import parameters
from dualbrain.skills.arm.controller import Limb, lifted
from dualbrain.skills.arm.place import spot
from dualbrain.skills.arm.waypoints import bend, travel, wait_for_people
from dualbrain.skills.kinematics import object_geometry
from dualbrain.skills.skill import Ending, Status, Story

OVER = 0.03
"""Room between the lowest carried point and the top of the thing below it [m]."""


def spec(body: Body) -> SkillSpec:
    """The skill's vocabulary entry; what is held may still leave its support."""
    return SkillSpec(
        "move_to",
        "bring the hand above an object, container or place, without touching it",
        (
            Name("target", "any", "what to go above"),
            parameters.speed(body),
            parameters.clearance(),
            parameters.route(),
            parameters.wait(),
        ),
        (ContactPermit("rise", "held", "support", parameters.CONTACT_SPEED),),
    )


def story(limb: Limb, *, target: str, speed: float, clearance: float, route: str, wait: str) -> Story:
    """Tell the journey: wait, rise, cross."""
    support = limb.support
    limb.begin(spec(limb.body), support=support.name if support else None)
    scene = limb.senses.scene
    if target in scene.graspable:
        thing = scene.find(target)
        point = np.array([*thing.pose.position[:2], object_geometry.top(thing)])
    else:
        point, _, _ = spot(scene, target)
    height = max(limb.floor + clearance, float(point[2]) + OVER) + limb.below_tool
    tool = limb.senses.tool
    end = yield from limb.goal(np.array([point[0], point[1], height]), _facings(tool.rotation, tool.position, point))
    if end is None:
        return Ending(Status.FAILED, f"above {target} is out of reach")
    middle = (tool.position + point) / 2
    if wait == "until_clear" and (
        why := (yield from wait_for_people(limb, limb.here(), middle, 4.0, "approach", speed, reach=0.35))
    ):
        return why
    points = [lifted(limb.here(), height)] if tool.position[2] < height - 0.01 else []
    via = bend(tool.position, end.position, route)
    if via is not None:
        points.append((yield from limb.shifted(end, via)))
    if why := (yield from travel(limb, [*points, end], "approach", speed)):
        return why
    return Ending(Status.DONE, f"above {target}")


def _facings(rotation: np.ndarray, start: np.ndarray, end: np.ndarray) -> list[np.ndarray]:
    """The rotation as it is, and turned with the arm's swing."""
    swing = float(np.arctan2(end[1], end[0]) - np.arctan2(start[1], start[0]))
    c, s = np.cos(swing), np.sin(swing)
    return [rotation.copy(), np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ rotation]
