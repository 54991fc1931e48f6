"""Whether two scenes show the same place: the same objects at the same positions, with any names.

The symbols of a scene summary, by which memories are retrieved, contain no positions. The outcome of a contract depends
on them, so evidence of one contract counts without the planner only where every object is in its former position.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, permutations, product
from math import cos, radians

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Bowl, Box, HalfSpace, Pose, Shape, Sphere
from dualbrain.records import Scene, SceneObject

MAX_DISTANCE = 0.02
"""Largest distance [m] of two perceived positions of one object: the error of a camera, twice."""
MAX_ANGLE = radians(10.0)
"""Largest angle [rad] between two perceived orientations of one object."""
MAX_SIZE_DIFFERENCE = 0.005
"""Largest difference [m] of two perceived sizes of one object."""
MAX_JOINT_DIFFERENCE = 0.05
"""Largest difference [rad or m] of each joint position of the robot at the two requests."""

Array = NDArray[np.float64]

CUBE_TURNS: tuple[Array, ...] = tuple(
    turn
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
    if np.linalg.det(turn := np.eye(3)[list(order)] * signs) > 0.0
)
"""The 24 rotations (3, 3) that bring a cube onto itself."""


def same_posture(one: Sequence[float], other: Sequence[float]) -> bool:
    """Whether all joint positions (n,) agree within `MAX_JOINT_DIFFERENCE`."""
    return len(one) == len(other) and bool(np.all(np.abs(np.subtract(one, other)) <= MAX_JOINT_DIFFERENCE))


def match_places(then: Scene, now: Scene) -> dict[str, str] | None:
    """The name in `now` of each object and place of `then`; None if the scenes do not show the same place.

    People move, so their number is compared, not their positions. A place of `then` that `now` does not have at the
    same position has no name.
    """
    if then.region != now.region or _n_persons(then) != _n_persons(now):
        return None
    before, after = _standing(then), _standing(now)
    if len(before) != len(after):
        return None
    names: dict[str, str] = {}
    for one in before:
        named = (other for other in after if other.name == one.name)
        found = next((other for other in chain(named, after) if is_same_object(one, other)), None)
        if found is None:
            return None
        names[one.name] = found.name
    if len(set(names.values())) != len(after):
        return None
    positions = {place.name: place.position for place in now.places}
    kept = (place.name for place in then.places if _is_near(place.position, positions.get(place.name)))
    return names | {name: name for name in kept}


def is_same_object(one: SceneObject, other: SceneObject) -> bool:
    """Whether both have the same role, shape, size and pose, within the errors of perception."""
    return (
        one.role == other.role
        and type(one.shape) is type(other.shape)
        and _is_near(one.pose.position, other.pose.position)
        and _same_extent(one.shape, one.pose, other.shape, other.pose)
    )


def _standing(scene: Scene) -> list[SceneObject]:
    return [one for one in scene.objects if one.role != "person"]


def _n_persons(scene: Scene) -> int:
    return sum(one.role == "person" for one in scene.objects)


def _is_near(one: Sequence[float], other: Sequence[float] | None) -> bool:
    return other is not None and float(np.linalg.norm(np.subtract(one, other))) <= MAX_DISTANCE


def _same_extent(one: Shape, pose: Pose, other: Shape, other_pose: Pose) -> bool:
    """Whether sizes and orientations agree: of a box up to its symmetries, of a round shape by its axis."""
    first, second = (quaternion_to_matrix(each.quaternion) for each in (pose, other_pose))
    match one, other:
        case (Box(), Box()):
            return _same_box(np.array(one.half_extents), first, np.array(other.half_extents), second)
        case (Bowl() | HalfSpace(), _):
            cosine = float(first[:, 2] @ second[:, 2])
        case _:  # the same upside down
            cosine = abs(float(first[:, 2] @ second[:, 2]))
    is_aligned = isinstance(one, Sphere) or cosine >= cos(MAX_ANGLE)
    return is_aligned and _same_size(_sizes(one), _sizes(other))


def _sizes(shape: Shape) -> tuple[float, ...]:
    """All lengths [m] of a round shape, none of a half space."""
    return tuple(value for value in msgspec.structs.astuple(shape) if isinstance(value, float))


def _same_box(extents: Array, first: Array, other_extents: Array, second: Array) -> bool:
    """Whether one of the 24 turns of a cube brings one box onto the other; rotations (3, 3), half extents (3,) [m]."""
    between = first.T @ second
    for turn in CUBE_TURNS:
        cosine = (float(np.trace(between @ turn.T)) - 1.0) / 2.0
        if cosine >= cos(MAX_ANGLE) and _same_size(extents, np.abs(turn) @ other_extents):
            return True
    return False


def _same_size(one: Sequence[float] | Array, other: Sequence[float] | Array) -> bool:
    return bool(np.all(np.abs(np.subtract(one, other)) <= MAX_SIZE_DIFFERENCE))
