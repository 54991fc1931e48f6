"""Relations of perceived objects, with perception error: true, false, or undecided within the error (None).

Every decision compares a length with a limit. It is made only if the same decision holds for all true positions within
the error bounds of the perceived ones; so noise within the bounds never turns true into false.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, HalfSpace, Shape, Sphere
from dualbrain.grounding.instruction.goals.goal import Relation
from dualbrain.records import Place, Scene, SceneObject

PLACE_RADIUS = 0.05
"""An object within this distance of a named place is at the place [m]."""
SURFACE_TOLERANCE = 0.03
"""An object whose lowest point is within this of a support rests on it [m]."""
NEAR_GAP = 0.15
"""Objects with a horizontal gap up to this are near each other [m]."""
MOVED_DISTANCE = 0.03
"""An object farther than this from its position before has moved [m]."""
RIM_TOLERANCE = 0.01
"""Height [m] above the rim of a bowl up to which the centre of an object is inside."""
TOPPLED_ANGLE = float(np.deg2rad(30.0))
"""An object whose axis has turned by more than this has toppled [rad]."""
UNDECIDED = None


def below(value: float, limit: float, error: float) -> bool | None:
    """Whether a length within `error` of `value` is below `limit`; None if that depends on the error."""
    if value + error < limit:
        return True
    return False if value - error >= limit else UNDECIDED


def all_true(values: Iterable[bool | None]) -> bool | None:
    """Conjunction: false if one is false, undecided if one is undecided."""
    found = list(values)
    if False in found:
        return False
    return UNDECIDED if None in found else True


def any_true(values: Iterable[bool | None]) -> bool | None:
    """Disjunction: true if one is true, undecided if one is undecided."""
    return negate(all_true(map(negate, values)))


def negate(value: bool | None) -> bool | None:
    """The opposite; undecided stays undecided."""
    return value if value is None else not value


def half_width(shape: Shape) -> float:
    """Largest horizontal half extent [m] of an upright shape."""
    match shape:
        case Bowl(radius, _, _) | Cylinder(radius, _):
            return radius
        case Sphere(radius):
            return radius
        case Capsule(radius, _):
            return radius
        case Box(half_extents):
            return float(np.hypot(*half_extents[:2]))
        case _:
            return 0.0


def vertical_extent(obj: SceneObject) -> tuple[float, float]:
    """Lowest and highest point [m] of `obj` at its perceived orientation."""
    z, axes = obj.pose.position[2], np.abs(quaternion_to_matrix(obj.pose.quaternion)[2])
    match obj.shape:
        case Box(half_extents):
            reach = float(axes @ np.asarray(half_extents))
        case Cylinder(radius, half_height):
            reach = float(axes[2] * half_height + np.sqrt(max(0.0, 1.0 - axes[2] ** 2)) * radius)
        case Sphere(radius):
            reach = radius
        case Capsule(radius, half_length):
            reach = float(axes[2] * half_length + radius)
        case Bowl(_, height, _):
            return z, z + height
        case _:
            reach = 0.0
    return z - reach, z + reach


def horizontal_distance(obj: SceneObject, other: SceneObject | Place) -> float:
    """Horizontal distance of the centres [m]."""
    at = other.position if isinstance(other, Place) else other.pose.position
    return float(np.hypot(obj.pose.position[0] - at[0], obj.pose.position[1] - at[1]))


def is_inside(obj: SceneObject, container: SceneObject) -> bool | None:
    """Whether `obj` is inside `container`: its centre within the wall and above the bottom, and low enough.

    Low enough is a centre below the rim, or, for an object taller than the bowl, a lowest point in its lower half.
    """
    error = obj.error + container.error
    bowl = container.shape
    if not isinstance(bowl, Bowl):
        return is_on(obj, container)
    height = obj.pose.position[2] - container.pose.position[2]
    within = below(horizontal_distance(obj, container), bowl.radius - bowl.wall, error)
    lowest = vertical_extent(obj)[0] - container.pose.position[2]
    low = any_true((below(height, bowl.height + RIM_TOLERANCE, error), below(lowest, 0.5 * bowl.height, error)))
    return all_true((within, negate(below(height, 0.0, error)), low))


def is_on(obj: SceneObject, other: SceneObject) -> bool | None:
    """Whether `obj` is over `other` and its lowest point is above the middle of `other`."""
    error = obj.error + other.error
    low, high = vertical_extent(other)
    over = below(horizontal_distance(obj, other), half_width(other.shape), error)
    lifted = negate(below(vertical_extent(obj)[0], 0.5 * (low + high), error))
    near = below(vertical_extent(obj)[0], high + 2.0 * SURFACE_TOLERANCE, error)
    return all_true((over, lifted, near))


def is_at(obj: SceneObject, place: Place) -> bool | None:
    """Whether `obj` is at `place`, on the surface of the place."""
    near = below(horizontal_distance(obj, place), PLACE_RADIUS, obj.error)
    return all_true((near, _is_level(vertical_extent(obj)[0] - place.position[2], obj.error)))


def is_lowered(obj: SceneObject, scene: Scene) -> bool | None:
    """Whether `obj` rests on the support below it, neither above nor below it, as on the floor beside a table."""
    return _is_level(vertical_extent(obj)[0] - support_height(scene, obj), obj.error)


def _is_level(height: float, error: float) -> bool | None:
    """Whether a lowest point at `height` [m] above a surface, within `error`, is on the surface."""
    return all_true((below(height, SURFACE_TOLERANCE, error), negate(below(height, -SURFACE_TOLERANCE, error))))


def support_height(scene: Scene, obj: SceneObject) -> float:
    """Height [m] of the highest support surface below `obj`, or else of the nearest one; without any, of the floor."""
    supports = [one for one in scene.objects if one.role == "support"]
    if not supports:
        return 0.0
    nearest = min(supports, key=lambda one: (_distance_outside(one, obj), -_surface_height(one)))
    return _surface_height(nearest)


def _surface_height(support: SceneObject) -> float:
    return 0.0 if isinstance(support.shape, HalfSpace) else vertical_extent(support)[1]


def _distance_outside(support: SceneObject, obj: SceneObject) -> float:
    """Horizontal distance [m] of the centre of `obj` from the outline of a support; 0 above it."""
    if isinstance(support.shape, HalfSpace):
        return 0.0
    if not isinstance(support.shape, Box):
        return max(0.0, horizontal_distance(obj, support) - half_width(support.shape))
    axes = quaternion_to_matrix(support.pose.quaternion)[:2, :2]
    offset = np.subtract(obj.pose.position, support.pose.position)[:2]
    beyond = np.maximum(np.abs(offset @ axes) - support.shape.half_extents[:2], 0.0)
    return float(np.hypot(*beyond))


def relation_holds(obj: SceneObject, relation: Relation, references: tuple[str, ...], scene: Scene) -> bool | None:
    """Whether `obj` is in `relation` to `references` in `scene`; undecided for a reference that is not perceived."""
    places = {place.name: place for place in scene.places}
    objects = {one.name: one for one in scene.objects}
    found = [places.get(name) or objects.get(name) for name in references]
    if None in found:
        return UNDECIDED
    known = [one for one in found if one is not None]
    if relation == "between":
        return _is_between(obj, known, scene)
    return _holds(obj, relation, known[0], scene)


def _holds(obj: SceneObject, relation: Relation, other: SceneObject | Place, scene: Scene) -> bool | None:
    if isinstance(other, Place):
        return _holds_at_place(obj, relation, other)
    inside, on, error = is_inside(obj, other), is_on(obj, other), obj.error + other.error
    apart = all_true((negate(inside), negate(on), is_lowered(obj, scene)))
    gap = horizontal_distance(obj, other) - half_width(obj.shape) - half_width(other.shape)
    dx, dy = (obj.pose.position[i] - other.pose.position[i] for i in (0, 1))
    views: dict[Relation, bool | None] = {
        "in": inside,
        "on": on,
        "at": all_true((apart, below(gap, NEAR_GAP, error))),
        "near": all_true((apart, below(gap, NEAR_GAP, error))),
        "left_of": all_true((apart, below(abs(dx) - dy, 0.0, 2.0 * error))),
        "right_of": all_true((apart, below(abs(dx) + dy, 0.0, 2.0 * error))),
        "away_from": all_true((negate(inside), negate(on))),
        "off": all_true((negate(inside), negate(on))),
    }
    if relation in ("in_front_of", "behind"):  # the words do not state the point of view
        return False if apart is False or below(abs(dx), abs(dy), 2.0 * error) else UNDECIDED
    return views.get(relation, UNDECIDED)


def _holds_at_place(obj: SceneObject, relation: Relation, place: Place) -> bool | None:
    if relation in ("in", "on", "at"):
        return is_at(obj, place)
    if relation == "near":
        return below(horizontal_distance(obj, place), NEAR_GAP, obj.error)
    return UNDECIDED


def _is_between(obj: SceneObject, ends: list[SceneObject | Place], scene: Scene) -> bool | None:
    """Whether the foot of `obj` is in the middle 80 % of the line of `ends`, at most 8 cm beside it."""
    a, b = (np.asarray(one.position if isinstance(one, Place) else one.pose.position)[:2] for one in ends)
    length = float(np.linalg.norm(b - a))
    if length <= 0.0:
        return UNDECIDED
    along = (b - a) / length
    offset = np.asarray(obj.pose.position)[:2] - a
    error = obj.error + max(one.error if isinstance(one, SceneObject) else 0.0 for one in ends)
    t, beside = float(offset @ along), float(abs(offset[0] * along[1] - offset[1] * along[0]))
    inner = all_true((negate(below(t, 0.1 * length, error)), below(t, 0.9 * length, error)))
    return all_true((inner, below(beside, 0.08, error), is_lowered(obj, scene)))


def is_container_empty(scene: Scene, name: str) -> bool | None:
    """Whether no object is inside the container `name`; None if it is not perceived, or cannot be decided."""
    container = next((obj for obj in scene.objects if name in (obj.name, obj.category)), None)
    if container is None or container.role != "container":
        return UNDECIDED
    return all_true(negate(is_inside(obj, container)) for obj in scene.objects if obj.role == "object")


def displacement(before: SceneObject, after: SceneObject) -> tuple[float, float]:
    """Distance of the perceived positions, and the error of that distance [m]."""
    distance = float(np.linalg.norm(np.subtract(after.pose.position, before.pose.position)))
    return distance, before.error + after.error


def has_moved(before: SceneObject, after: SceneObject) -> bool | None:
    """Whether an object has moved by more than `MOVED_DISTANCE`."""
    distance, error = displacement(before, after)
    return negate(below(distance, MOVED_DISTANCE, error))


def has_toppled(before: SceneObject, after: SceneObject) -> bool:
    """Whether the vertical axis of an object has turned by more than `TOPPLED_ANGLE`."""
    axes = [quaternion_to_matrix(one.pose.quaternion)[:, 2] for one in (before, after)]
    return float(np.arccos(np.clip(axes[0] @ axes[1], -1.0, 1.0))) > TOPPLED_ANGLE
