"""Whether the conditions of a goal hold in the evidence about an episode: true, false, or undecided (None)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dualbrain.grounding.instruction.goals.goal import (
    Condition,
    Direction,
    Goal,
    Held,
    Observed,
    Placed,
    Pushed,
    RobotEnds,
    Unmoved,
)
from dualbrain.grounding.outcome.evidence import Evidence
from dualbrain.grounding.outcome.spatial_relations import (
    all_true,
    below,
    displacement,
    has_moved,
    has_toppled,
    is_inside,
    is_lowered,
    negate,
    relation_holds,
    support_height,
    vertical_extent,
)
from dualbrain.records import SceneObject

HOME_TOLERANCE = 0.05
"""An arm is at home if every joint is within this of its home position [rad]."""
STILL_TOLERANCE = 0.10
"""A robot that was to stand still has not moved a joint by more than this [rad, m]."""
ARRIVAL_DISTANCE = 0.20
"""A base is at a place within this distance [m]."""
MIN_PUSH = 0.02
"""A pushed object has moved at least this far in the direction [m]."""
LIFT_HEIGHT = 0.02
"""An object in the hand is held up if its lowest point is at least this far above its height before [m].

For an object that was in the hand before, it is the height above the support.
"""


def condition_holds(condition: Condition, evidence: Evidence) -> bool | None:
    """Whether `condition` holds at the end of the episode."""
    match condition:
        case Placed():
            return _placed(condition, evidence)
        case Held(objects, handed):
            return _held(objects, evidence, handed=handed)
        case Pushed(objects, direction, reference):
            return all_true(_pushed(name, direction, reference, evidence) for name in objects)
        case Unmoved(objects):
            return all_true(negate(moved(name, evidence)) for name in objects)
        case Observed(name, is_moved):
            return False if not is_moved and moved(name, evidence) else None
        case RobotEnds():
            return _robot_ends(condition, evidence)


def others_unmoved(goal: Goal, evidence: Evidence) -> dict[str, bool | None]:
    """For each object that the goal does not move: whether it stayed where it was; an object kept in the hand did."""
    others = [name for name in evidence.movable_names if name not in (*goal.movable, evidence.kept_in_hand)]
    return {name: negate(moved(name, evidence)) for name in others}


def moved(name: str, evidence: Evidence) -> bool | None:
    """Whether the object `name` has moved, toppled, or is in the hand; undecided if it is no longer perceived."""
    before, after = evidence.object_before(name), evidence.object_after(name)
    if name == evidence.in_hand:
        return True
    if before is None or after is None:
        return None
    return True if has_toppled(before, after) else has_moved(before, after)


def _placed(condition: Placed, evidence: Evidence) -> bool | None:
    """Whether the right number of objects is released in the relation; objects beyond the number must not be."""
    holds = [_is_placed(name, condition, evidence) for name in condition.objects]
    if condition.count is None:
        return all_true(holds)
    certain, possible = holds.count(True), len(holds) - holds.count(False)
    if certain == possible == condition.count:
        return True
    return False if condition.count > possible or condition.count < certain else None


def _is_placed(name: str, condition: Placed, evidence: Evidence) -> bool | None:
    obj = evidence.object_after(name)
    if name == evidence.in_hand or name in evidence.touched or name in evidence.unsettled:
        return False
    if obj is None:
        return None
    related = relation_holds(obj, condition.relation, condition.references, evidence.after)
    before = evidence.object_before(name)
    if before is not None and condition.relation == "at" and has_toppled(before, obj):
        return False
    return related


def _held(objects: Sequence[str], evidence: Evidence, *, handed: bool) -> bool | None:
    if evidence.in_hand not in objects:
        return False
    if handed:  # no sensor of the robot perceives whether a person has taken the object
        return None
    before, after = evidence.object_before(evidence.in_hand), evidence.object_after(evidence.in_hand)
    if before is None or after is None:
        return None
    if evidence.kept_in_hand:  # its height before is that in the hand
        return negate(
            below(vertical_extent(after)[0] - support_height(evidence.after, after), LIFT_HEIGHT, after.error)
        )
    rise = vertical_extent(after)[0] - vertical_extent(before)[0]
    return negate(below(rise, LIFT_HEIGHT, before.error + after.error))


def _pushed(name: str, direction: Direction, reference: str, evidence: Evidence) -> bool | None:
    before, after = evidence.object_before(name), evidence.object_after(name)
    if before is None or after is None:
        return None
    way = _direction(direction, reference, before, evidence)
    if way is None:
        return None
    shift = np.subtract(after.pose.position, before.pose.position)[:2]
    _, error = displacement(before, after)
    inside = [is_inside(after, obj) for obj in evidence.after.objects if obj.role == "container"]
    lowered = all_true((is_lowered(after, evidence.after), *(negate(one) for one in inside)))
    return all_true((name != evidence.in_hand, negate(below(float(shift @ way), MIN_PUSH, error)), lowered))


def _direction(
    direction: Direction, reference: str, before: SceneObject, evidence: Evidence
) -> np.ndarray[tuple[int], np.dtype[np.float64]] | None:
    """Unit vector (2,) of the push; "forward" leads away from the base of the robot."""
    spot = np.asarray(before.pose.position)[:2]
    if direction in ("left", "right"):
        return np.array([0.0, 1.0 if direction == "left" else -1.0])
    if direction in ("forward", "backward"):
        way = spot / (np.linalg.norm(spot) + 1e-9)
        return way if direction == "forward" else -way
    places = {place.name: place.position for place in evidence.before.places}
    other = evidence.object_before(reference)
    at = places.get(reference) or (other.pose.position if other else None)
    if at is None:
        return None
    way = np.asarray(at)[:2] - spot
    way = way / (np.linalg.norm(way) + 1e-9)
    return way if direction == "toward" else -way


def _robot_ends(condition: RobotEnds, evidence: Evidence) -> bool | None:
    match condition.movement:
        case "still":
            return _kept_still(evidence)
        case "home":
            return _is_at_home(evidence)
        case "rest":
            return _kept_still(evidence) or _is_at_home(evidence)
        case "drive":
            place = next((one for one in evidence.after.places if one.name == condition.place), None)
            if place is None or evidence.base_after is None:
                return None
            gap = np.hypot(evidence.base_after[0] - place.position[0], evidence.base_after[1] - place.position[1])
            return bool(gap < ARRIVAL_DISTANCE)


def _kept_still(evidence: Evidence) -> bool:
    return bool(np.max(np.abs(evidence.q_after - evidence.q_before), initial=0.0) < STILL_TOLERANCE)


def _is_at_home(evidence: Evidence) -> bool | None:
    if not len(evidence.home):
        return None
    arm = evidence.q_after[-len(evidence.home) :]
    return bool(np.max(np.abs(arm - evidence.home), initial=0.0) < HOME_TOLERANCE)
