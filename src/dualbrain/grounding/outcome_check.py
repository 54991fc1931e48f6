"""Check of an outcome by perception: whether the objects are where the contract placed them.

The check is a second source of the robot itself (perception after the task), independent of the executed skills and
without simulator ground truth. Memory accepts a success immediately only if the check agrees.
"""

from __future__ import annotations

import numpy as np

from dualbrain.contracts.contract import Contract
from dualbrain.core.geometry.shapes import Bowl, Box, Cylinder
from dualbrain.records import Outcome, OutcomeCheck, Scene, SceneObject

PLACE_TOLERANCE = 0.06
"""An object within this distance of a named place is at the place [m]."""
MOTION_ONLY_SKILLS = ("move_to", "home", "hold", "drive_to", "turn_to", "stop")
"""Skills that move the robot, but no object."""


def check_outcome(scene: Scene, contract: Contract | None, outcome: Outcome) -> OutcomeCheck:
    """Whether `scene`, perceived after the motion, agrees with a success or failure; "none" if it cannot be decided.

    The check covers every object that the contract grasps and then places, at its last destination: after a success
    all of them must be there, after a failure at least one must not. If one of them is not perceived, the result is
    "none". A contract that moves only the robot always agrees, because the joint encoders confirm it.
    """
    if contract is None or outcome.kind not in ("succeeded", "failed"):
        return "none"
    if all(action.skill in MOTION_ONLY_SKILLS for action in contract.action_sequence):
        return "agrees"
    placed = [_is_at(scene, *expected) for expected in _expected_placements(contract).items()]
    if not placed or None in placed:
        return "none"
    return "agrees" if all(placed) == (outcome.kind == "succeeded") else "disagrees"


def _expected_placements(contract: Contract) -> dict[str, str]:
    """The last destination of each object that the contract grasps and then places."""
    obj: str | None = None
    found: dict[str, str] = {}
    for action in contract.action_sequence:
        if action.skill == "grasp":
            obj = str(action.params["object"])
        elif action.skill == "place" and obj is not None:
            found[obj] = str(action.params["destination"])
    return found


def _is_at(scene: Scene, name: str, destination: str) -> bool | None:
    objects = {obj.name: obj for obj in scene.objects}
    places = {place.name: place.position for place in scene.places}
    if name not in objects:
        return None
    obj = objects[name]
    at = np.asarray(obj.pose.position)[:2]
    if destination in places:
        return bool(np.linalg.norm(at - np.asarray(places[destination])[:2]) < PLACE_TOLERANCE + obj.error)
    if destination not in objects:
        return None
    target = objects[destination]
    reach = _half_width(target)
    if reach is None:
        return None
    return bool(np.linalg.norm(at - np.asarray(target.pose.position)[:2]) < reach + obj.error + target.error)


def _half_width(obj: SceneObject) -> float | None:
    match obj.shape:
        case Bowl(radius, _, _) | Cylinder(radius, _):
            return radius
        case Box(half_extents):
            return max(half_extents[:2])
        case _:
            return None
