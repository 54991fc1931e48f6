"""What the robot's eyes say of an outcome, apart from the skills that carried it out: is the thing where it belongs?

It is a second robot-side source (perception after the task), not simulator truth; memory believes a success at once
only if it agrees.
"""

from __future__ import annotations

import numpy as np

from dualbrain.contracts.contract import Contract
from dualbrain.core.geometry.shapes import Bowl, Box, Cylinder
from dualbrain.records import Outcome, OutcomeCheck, Scene, SceneObject

PLACE_TOLERANCE = 0.06
"""A thing this near to a named place is there [m]."""
MOTION_ONLY_SKILLS = ("move_to", "home", "hold", "drive_to", "turn_to", "stop")
"""Skills that move the robot and nothing else."""


def check_outcome(scene: Scene, contract: Contract | None, outcome: Outcome) -> OutcomeCheck:
    """Whether `scene`, as perceived after the motion, agrees with a success or failure; "none" if it cannot tell.

    It judges everything that the contract grasps and then places, each where it was placed last: after a success all of
    it must be there, after a failure some of it not; what is not seen it has no word on. Of a contract that moves
    nothing but the arm there is nothing to be seen: the joint encoders are word enough.
    """
    if contract is None or outcome.kind not in ("succeeded", "failed"):
        return "none"
    if all(action.skill in MOTION_ONLY_SKILLS for action in contract.action_sequence):
        return "agrees"
    there = [_is_at(scene, *wanted) for wanted in _expected_placements(contract).items()]
    if not there or None in there:
        return "none"
    return "agrees" if all(there) == (outcome.kind == "succeeded") else "disagrees"


def _expected_placements(contract: Contract) -> dict[str, str]:
    """Where each thing that is grasped and then placed should be in the end."""
    thing: str | None = None
    found: dict[str, str] = {}
    for action in contract.action_sequence:
        if action.skill == "grasp":
            thing = str(action.params["object"])
        elif action.skill == "place" and thing is not None:
            found[thing] = str(action.params["destination"])
    return found


def _is_at(scene: Scene, name: str, destination: str) -> bool | None:
    things = {thing.name: thing for thing in scene.objects}
    places = {place.name: place.position for place in scene.places}
    if name not in things:
        return None
    thing = things[name]
    at = np.asarray(thing.pose.position)[:2]
    if destination in places:
        return bool(np.linalg.norm(at - np.asarray(places[destination])[:2]) < PLACE_TOLERANCE + thing.error)
    if destination not in things:
        return None
    target = things[destination]
    reach = _half_width(target)
    if reach is None:
        return None
    return bool(np.linalg.norm(at - np.asarray(target.pose.position)[:2]) < reach + thing.error + target.error)


def _half_width(thing: SceneObject) -> float | None:
    match thing.shape:
        case Bowl(radius, _, _) | Cylinder(radius, _):
            return radius
        case Box(half_extents):
            return max(half_extents[:2])
        case _:
            return None
