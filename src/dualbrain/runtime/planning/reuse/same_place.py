"""Whether two scenes show the same place: the same objects at the same positions, with any names.

The symbols of a scene summary, by which memories are retrieved, contain no positions. The outcome of a contract depends
on them, so evidence of one contract counts without the planner only where every object is in its former position.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from math import cos, radians

import msgspec
import numpy as np

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Bowl, Box, HalfSpace, Shape, Sphere
from dualbrain.records import Scene, SceneObject

MAX_DISTANCE = 0.02
"""Largest distance [m] of two perceived positions of one object: the error of a camera, twice."""
MAX_ANGLE = radians(10.0)
"""Largest angle [rad] between two perceived orientations of one object."""
MAX_SIZE_DIFFERENCE = 0.005
"""Largest difference [m] of two perceived sizes of one object."""
UNIT_TOLERANCE = 1e-3
"""Largest deviation of the norm of a unit quaternion."""
MAX_JOINT_DIFFERENCE = 0.05
"""Largest difference [rad or m] of each joint position of the robot at the two requests."""


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
    """Whether both have the same role, shape, size and pose, within the errors of perception.

    The axes of an object must agree up to their signs, also those of a cube or a cylinder: the finger axis of a grasp
    is one of them. Of a container, a plane and any other round shape the z axis must agree.
    """
    return (
        one.role == other.role
        and type(one.shape) is type(other.shape)
        and _is_near(one.pose.position, other.pose.position)
        and _same_size(one.shape, other.shape)
        and _same_axes(one, other)
    )


def _standing(scene: Scene) -> list[SceneObject]:
    return [one for one in scene.objects if one.role != "person"]


def _n_persons(scene: Scene) -> int:
    return sum(one.role == "person" for one in scene.objects)


def _is_near(one: Sequence[float], other: Sequence[float] | None) -> bool:
    return other is not None and float(np.linalg.norm(np.subtract(one, other))) <= MAX_DISTANCE


def _same_size(one: Shape, other: Shape) -> bool:
    return bool(np.all(np.abs(np.subtract(_sizes(one), _sizes(other))) <= MAX_SIZE_DIFFERENCE))


def _sizes(shape: Shape) -> tuple[float, ...]:
    """All lengths [m] of `shape`, none of a half space."""
    return shape.half_extents if isinstance(shape, Box) else msgspec.structs.astuple(shape)


def _same_axes(one: SceneObject, other: SceneObject) -> bool:
    """Whether the axes that matter agree; False for an orientation that is no unit quaternion."""
    if not (_is_unit(one.pose.quaternion) and _is_unit(other.pose.quaternion)):
        return False
    first, second = (quaternion_to_matrix(each.pose.quaternion) for each in (one, other))
    cosines = np.sum(first * second, axis=0)  # of the angle of each axis
    if isinstance(one.shape, Bowl | HalfSpace):
        return bool(cosines[2] >= cos(MAX_ANGLE))
    has_axes = one.role == "object" or isinstance(one.shape, Box)
    compared = cosines if has_axes else cosines[2:]
    return isinstance(one.shape, Sphere) or bool(np.all(np.abs(compared) >= cos(MAX_ANGLE)))


def _is_unit(quaternion: Sequence[float]) -> bool:
    return abs(float(np.linalg.norm(quaternion)) - 1.0) <= UNIT_TOLERANCE
