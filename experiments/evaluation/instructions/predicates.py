"""Predicates on the final state: whether each condition of an instruction holds, by the rules of `free.toml`."""

from __future__ import annotations

from collections.abc import Callable
from math import degrees, hypot

from dualbrain.core.geometry.shapes import Bowl, Box, Cylinder, Vector
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.placement import is_inside_bowl
from experiments.evaluation.instructions.final_state import FinalState
from experiments.evaluation.instructions.instruction_set import Predicate, PredicateKind

PLACE_TOLERANCE, ABOVE_TOLERANCE, NEAR_TOLERANCE = 0.05, 0.06, 0.20
"""Largest distances in the plane from a place on the table, from the object below the hand, from a place [m]."""
LIFT_HEIGHT = 0.03
"""Height above the initial one from which on an object counts as lifted [m]."""
MAX_UNMOVED_DISTANCE = 0.03
"""An object within this distance of its start has not moved [m]."""
MAX_STILL_JOINT, MAX_STILL_BASE = 0.02, 0.02
"""A robot within these of its initial posture has not moved [rad, m]."""
TURN_TOLERANCE = 15.0
"""[deg]"""
DIRECTIONS = {"far": (1.0, 0.0), "near": (-1.0, 0.0), "left": (0.0, 1.0), "right": (0.0, -1.0)}
"""Unit vector of each direction of the robot in the plane."""


def is_fulfilled(predicates: tuple[Predicate, ...], spec: SceneSpec, state: FinalState) -> bool:
    """Whether all `predicates` hold, no other object has moved, and nothing broke; False without predicates."""
    if not predicates or state.broken:
        return False
    named = {name for one in predicates for name in one.objects} | _containers_of(predicates, spec)
    others = [name for name in state.objects if name not in named]
    return all(holds(one, spec, state) for one in predicates) and all(is_unmoved(name, state) for name in others)


def holds(predicate: Predicate, spec: SceneSpec, state: FinalState) -> bool:
    """Whether one predicate holds."""
    check = _CHECKS[predicate.kind]
    if not predicate.any_of:
        return check(predicate, predicate.object, spec, state)
    fulfilled = [name for name in predicate.any_of if check(predicate, name, spec, state)]
    rest = [name for name in predicate.any_of if name not in fulfilled]
    return len(fulfilled) == predicate.count and all(is_unmoved(name, state) for name in rest)


def is_unmoved(name: str, state: FinalState) -> bool:
    """Whether an object is where it was at the start, and out of the fingers."""
    obj = state.objects[name]
    moved = sum((a - b) ** 2 for a, b in zip(obj.start, obj.end, strict=True)) ** 0.5
    return moved < MAX_UNMOVED_DISTANCE and not obj.fingers


def is_still(state: FinalState) -> bool:
    """Whether the robot has never left its initial posture."""
    return state.joint_motion < MAX_STILL_JOINT and state.base_motion < MAX_STILL_BASE


def _containers_of(predicates: tuple[Predicate, ...], spec: SceneSpec) -> set[str]:
    """Containers that are a destination: an object that is put in may shift them."""
    bowls = {obj.name for obj in spec.objects if isinstance(obj.shape, Bowl)}
    return {one.at for one in predicates if one.kind == "in"} & bowls


def _is_in(predicate: Predicate, name: str, spec: SceneSpec, state: FinalState) -> bool:
    obj, bowl = state.objects[name], spec.find(predicate.at)
    inside = is_inside_bowl(obj.end, _position(predicate.at, spec, state), bowl.shape, lowest=obj.lowest)
    return inside and not obj.fingers and obj.at_rest


def _is_at(predicate: Predicate, name: str, spec: SceneSpec, state: FinalState) -> bool:
    obj = state.objects[name]
    distance = _distance(obj.end, spec.find_place(predicate.at).position)
    on_table = 0.0 < obj.end[2] < spec.find(name).position[2] + 0.02
    return distance < PLACE_TOLERANCE and on_table and not obj.fingers and obj.at_rest


def _is_held(predicate: Predicate, name: str, spec: SceneSpec, state: FinalState) -> bool:
    del predicate, spec
    obj = state.objects[name]
    return obj.fingers == 2 and obj.end[2] > obj.start[2] + LIFT_HEIGHT


def _is_above(predicate: Predicate, name: str, spec: SceneSpec, state: FinalState) -> bool:
    del name
    empty = not any(obj.fingers for obj in state.objects.values())
    return empty and _distance(state.tool, _position(predicate.at, spec, state)) < ABOVE_TOLERANCE


def _is_toward(predicate: Predicate, name: str, spec: SceneSpec, state: FinalState) -> bool:
    obj, goal = state.objects[name], _position(predicate.at, spec, state)
    return _is_on_support(name, state) and _distance(obj.start, goal) - _distance(obj.end, goal) >= predicate.least


def _is_shifted(predicate: Predicate, name: str, spec: SceneSpec, state: FinalState) -> bool:
    del spec
    obj, (x, y) = state.objects[name], DIRECTIONS[predicate.direction]
    return _is_on_support(name, state) and _along(obj.start, obj.end, x, y) >= predicate.least


def _is_beside(predicate: Predicate, name: str, spec: SceneSpec, state: FinalState) -> bool:
    obj, at, (x, y) = state.objects[name], _position(predicate.at, spec, state), DIRECTIONS[predicate.side]
    along, distance = _along(at, obj.end, x, y), _distance(at, obj.end)
    gap = distance - _half_width(name, spec) - _half_width(predicate.at, spec)
    return (
        along > 0.7 * distance and -0.005 < gap < predicate.within and not obj.fingers and _is_on_support(name, state)
    )


def _is_home(predicate: Predicate, name: str, spec: SceneSpec, state: FinalState) -> bool:
    del predicate, name, spec
    return state.home


def _is_robot_still(predicate: Predicate, name: str, spec: SceneSpec, state: FinalState) -> bool:
    del predicate, name, spec
    return is_still(state)


def _is_near(predicate: Predicate, name: str, spec: SceneSpec, state: FinalState) -> bool:
    del name
    x, y, *_ = spec.find_place(predicate.at).position
    return hypot(state.ground[0] - x, state.ground[1] - y) < NEAR_TOLERANCE


def _is_turned(predicate: Predicate, name: str, spec: SceneSpec, state: FinalState) -> bool:
    del name, spec
    return abs(degrees(state.turn) - predicate.angle) < TURN_TOLERANCE


def _is_object_unmoved(predicate: Predicate, name: str, spec: SceneSpec, state: FinalState) -> bool:
    del predicate, spec
    return is_unmoved(name, state)


_CHECKS: dict[PredicateKind, Callable[[Predicate, str, SceneSpec, FinalState], bool]] = {
    "in": _is_in,
    "at": _is_at,
    "held": _is_held,
    "above": _is_above,
    "toward": _is_toward,
    "shifted": _is_shifted,
    "beside": _is_beside,
    "home": _is_home,
    "still": _is_robot_still,
    "near": _is_near,
    "turned": _is_turned,
    "unmoved": _is_object_unmoved,
}


def _position(name: str, spec: SceneSpec, state: FinalState) -> Vector:
    """The final position of an object, or the position of a place."""
    if name in state.objects:
        return state.objects[name].end
    fixed = {obj.name: obj.position for obj in spec.objects}
    return fixed[name] if name in fixed else spec.find_place(name).position


def _distance(one: Vector, other: Vector) -> float:
    return hypot(one[0] - other[0], one[1] - other[1])


def _along(start: Vector, end: Vector, x: float, y: float) -> float:
    return (end[0] - start[0]) * x + (end[1] - start[1]) * y


def _is_on_support(name: str, state: FinalState) -> bool:
    obj = state.objects[name]
    return abs(obj.end[2] - obj.start[2]) < LIFT_HEIGHT


def _half_width(name: str, spec: SceneSpec) -> float:
    match spec.find(name).shape:
        case Bowl(radius, _, _) | Cylinder(radius, _):
            return radius
        case Box(half_extents):
            return max(half_extents[:2])
        case _:
            return 0.0
