"""Symbolic summary of a scene for the planner, because a small language model cannot compare numbers.

The symbols are those that determine the best contract: the neighbours of an object along the finger axis and across it
(height class, gap class) in the frame of the object, obstacles on or above the path to a container, and people.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Bowl, Box, Pose
from dualbrain.grounding.parameter_values import fitted_opening, path_clearance
from dualbrain.grounding.scene_paths import (
    PathEnd,
    footprint_radius,
    is_below_overhead_object,
    objects_on_path,
    overhead_objects_on_path,
    path_ends,
    standing_objects,
)
from dualbrain.records import Place, Scene, SceneObject
from dualbrain.skills.kinematics.object_geometry import bottom_height, finger_direction, grasp_width, top_height

Array = NDArray[np.float64]

LOW_HEIGHT, HAND_HEIGHT = 0.09, 0.13
"""A neighbour below the first height [m] stays under the hand; above the second it is tall."""
NEAR_GAP, FAR_GAP = 0.03, 0.06
"""Boundaries of the gap classes [m]."""
MAX_NEIGHBOUR_GAP = 0.12
"""An object with a wider gap is not a neighbour [m]."""
EDGE_DISTANCE = 0.06
"""An object within this distance of the edge of its support is near the edge [m]."""
SUPPORT_TOLERANCE, FURNITURE_REACH = 0.05, 0.7
"""An object is on furniture if its bottom is within the first of the top; a place is at furniture within the second
[m]."""
AISLE_PREFIX, AISLE_RADIUS = "aisle_", 1.2
"""Prefix of the names of places in aisles, and radius around such a place that counts as the aisle [m]."""


def summarise_scene(scene: Scene, holding: str | None = None, *, values: bool = False) -> str:
    """The summary of `scene` in a planner prompt: one line per object, container and person, with symbols only.

    For a room with furniture it also contains the place and the heading from which each object can be reached. With
    `values`, the lines of a table's objects also state an opening and a clearance [m] that fit (`parameter_values`).
    """
    if scene.region:
        return _summarise_workroom(scene, holding) if _furniture(scene) else _summarise_room(scene)
    lines = [f"robot {scene.robot}; holding {holding or 'nothing'}"]
    lines += [_object_line(scene, obj, values=values) for obj in scene.objects if obj.role == "object"]
    containers = (obj for obj in scene.objects if obj.role == "container")
    lines += [f"{obj.name}: container{_contents_suffix(scene, obj)}" for obj in containers]
    lines.append(f"person: {_person_state(scene)}")
    if scene.places:
        lines.append(_places_line(scene))
    return "\n".join(lines)


def held_in_summary(summary: str) -> str | None:
    """The name of the held object in a summary, None if nothing is held."""
    _, _, held = summary.partition("\n")[0].partition("; holding ")
    return held if held and held != "nothing" else None


def _places_line(scene: Scene) -> str:
    return "places: " + ", ".join(place.name for place in scene.places)


def _obstacles_line(scene: Scene, roles: tuple[str, ...]) -> str:
    names = ", ".join(obj.name for obj in scene.objects if obj.role in roles)
    return f"standing about: {names or 'nothing'}"


def _contents_suffix(scene: Scene, container: SceneObject) -> str:
    """The objects in a container, or "" for an empty one."""
    bowl = container.shape
    if not isinstance(bowl, Bowl):
        return ""
    x, y, z = container.pose.position
    contents = [
        obj.name
        for obj in scene.objects
        if obj.role == "object"
        and np.hypot(obj.pose.position[0] - x, obj.pose.position[1] - y) < bowl.radius - bowl.wall
        and 0.0 < obj.pose.position[2] - z < bowl.height + 0.01
    ]
    return f", holds {' and '.join(contents)}" if contents else ""


def _summarise_room(scene: Scene) -> str:
    """The summary of a room for a mobile base: places, obstacles, aisles and people."""
    lines = [f"robot {scene.robot}", _places_line(scene), _obstacles_line(scene, ("object", "obstacle", "container"))]
    aisles = ", ".join(f"{place.name} {_aisle_state(scene, place)}" for place in scene.places if _is_aisle(place))
    return "\n".join([*lines, *([f"aisles: {aisles}"] if aisles else []), f"person: {_person_state(scene)}"])


def _furniture(scene: Scene) -> list[SceneObject]:
    """The furniture of a room that supports objects."""
    return [obj for obj in scene.objects if obj.role == "support" and isinstance(obj.shape, Box)]


def _summarise_workroom(scene: Scene, holding: str | None) -> str:
    """The summary of a room for a mobile manipulator."""
    work_poses = {obj.name: _work_pose(scene, obj) for obj in _furniture(scene)}
    lines = [f"robot {scene.robot}; holding {holding or 'nothing'}", _places_line(scene)]
    lines += [f"{at.place}: before {name}, heading {at.heading:.2f}" for name, at in work_poses.items() if at]
    for obj in scene.objects:
        if obj.role not in ("object", "container") or obj.name == holding:
            continue
        support = _supporting_furniture(scene, obj)
        at = work_poses[support.name] if support else None
        where = f", at {at.place}" if at else ""
        if obj.role == "container":
            lines.append(f"{obj.name}: container{where}{_contents_suffix(scene, obj)}")
        else:
            relative = _relative_to_height(scene, top_height(support)) if support else scene
            line = _object_line(relative, relative.find(obj.name))
            lines.append(line.replace(": object", f": object{where}", 1))
    return "\n".join([*lines, _obstacles_line(scene, ("obstacle",)), f"person: {_person_state(scene)}"])


class WorkPose(NamedTuple):
    """A place from which a piece of furniture can be reached, and the heading [rad] towards it."""

    place: str
    heading: float


def _work_pose(scene: Scene, furniture: SceneObject) -> WorkPose | None:
    """The place nearest to `furniture`, if it is within `FURNITURE_REACH` of its edge."""
    gaps = {place.name: _vector_to_edge(furniture, np.asarray(place.position)) for place in scene.places}
    name = min(gaps, key=lambda name: float(np.linalg.norm(gaps[name])), default=None)
    if name is None or float(np.linalg.norm(gaps[name])) > FURNITURE_REACH:
        return None
    x, y = gaps[name]
    return WorkPose(name, float(np.arctan2(y, x)))


def _vector_to_edge(furniture: SceneObject, spot: Array) -> Array:
    """Vector (2,) [m] from `spot` to the nearest point of the footprint of `furniture`."""
    assert isinstance(furniture.shape, Box)
    rotation = quaternion_to_matrix(furniture.pose.quaternion)[:2, :2]
    half, centre = np.asarray(furniture.shape.half_extents)[:2], np.asarray(furniture.pose.position)[:2]
    local = (spot[:2] - centre) @ rotation
    return rotation @ (np.clip(local, -half, half) - local)


def _supporting_furniture(scene: Scene, obj: SceneObject) -> SceneObject | None:
    """The furniture that supports `obj`, or None."""
    return next(
        (
            one
            for one in _furniture(scene)
            if abs(bottom_height(obj) - top_height(one)) < SUPPORT_TOLERANCE
            and not np.any(_vector_to_edge(one, np.asarray(obj.pose.position)))
        ),
        None,
    )


def _relative_to_height(scene: Scene, height: float) -> Scene:
    """The scene in a frame at `height` [m], so that heights are relative to a table top."""

    def down(obj: SceneObject) -> SceneObject:
        x, y, z = obj.pose.position
        return msgspec.structs.replace(obj, pose=Pose((x, y, z - height), obj.pose.quaternion))

    return msgspec.structs.replace(scene, objects=tuple(down(obj) for obj in scene.objects))


def _is_aisle(place: Place) -> bool:
    return place.name.startswith(AISLE_PREFIX)


def _aisle_state(scene: Scene, place: Place) -> str:
    """The symbol of an aisle: "occupied" by a person, "narrow" with movable objects in it, or "free"."""
    middle = np.asarray(place.position)[:2]
    inside = [obj for obj in scene.objects if np.linalg.norm(np.asarray(obj.pose.position)[:2] - middle) < AISLE_RADIUS]
    roles = {obj.role for obj in inside}
    return "occupied" if "person" in roles else "narrow" if "object" in roles else "free"


def _object_line(scene: Scene, obj: SceneObject, *, values: bool = False) -> str:
    """One line: the freer finger axis, the neighbours in the frame of the object, the path to each container."""
    neighbours = {axis: _neighbours(scene, obj, axis) for axis in ("along", "across")}
    free, overlap = _freest_axis(neighbours)
    symbols = ["object", f"free_finger_axis {free}"]
    symbols += [f"opening {fitted_opening(obj, free):g}"] if values else []
    symbols += ["tight"] if overlap > TIGHT_OVERLAP else []
    for axis, found in neighbours.items():
        symbols += [f"neighbour_{axis} {max(found, key=lambda one: one.overlap)}"] if found else []
    symbols += ["near_edge"] if _is_near_edge(scene, obj) else []
    symbols += ["fragile"] if obj.fragile_limit is not None else []
    symbols += [_path_symbols(scene, obj, end, values=values) for end in path_ends(scene)]
    return f"{obj.name}: " + ", ".join(symbols)


def free_finger_axis(scene: Scene, obj: SceneObject) -> str:
    """The finger axis of `obj`, along or across, on which its neighbours leave more space for the hand."""
    return _freest_axis({axis: _neighbours(scene, obj, axis) for axis in ("along", "across")})[0]


def _freest_axis(neighbours: Mapping[str, list[Neighbour]]) -> tuple[str, float]:
    """The freer axis, and the overlap of its neighbours with the space of the hand [m]."""
    overlap = {axis: max((one.overlap for one in found), default=-1.0) for axis, found in neighbours.items()}
    free = min(overlap, key=lambda axis: overlap[axis])
    return free, overlap[free]


class Neighbour(NamedTuple):
    """A neighbour of an object: height class, gap class, and its overlap with the space of the hand [m]."""

    height: int
    gap: int
    overlap: float

    def __str__(self) -> str:
        """The symbols in the summary, such as "tall 3-6cm"."""
        return f"{HEIGHTS[self.height]} {GAPS[self.gap]}"


HEIGHTS = ("none", "low", "hand_high", "tall")
GAPS = (">6cm", "3-6cm", "<3cm")
HAND_HALF_WIDTH, FINGERS_HALF_WIDTH = 0.125, 0.065
"""Half width of the palm, and below it of the open fingers, along the finger axis, with margins [m]."""
PALM_CLEARANCE = 0.005
"""A neighbour that is higher than the grasped object by more than this meets the palm, not only the fingers [m]."""
HAND_HALF_BREADTH = 0.04
"""Half width of the hand across the finger axis [m]."""
TIGHT_OVERLAP = -0.01
"""With a larger overlap there is no free space for the hand on that axis [m]."""


def _neighbours(scene: Scene, obj: SceneObject, axis: str) -> list[Neighbour]:
    """The objects in the strip that a hand needs when its fingers close along `axis` of `obj`."""
    centre, direction = np.asarray(obj.pose.position)[:2], finger_direction(obj, axis)[:2]
    found: list[Neighbour] = []
    for other in standing_objects(scene, obj.name):
        offset, reach = np.asarray(other.pose.position)[:2] - centre, footprint_radius(other)
        ahead, lateral = abs(float(offset @ direction)), abs(float(direction[0] * offset[1] - direction[1] * offset[0]))
        gap = ahead - grasp_width(obj, axis) / 2 - reach
        if lateral < HAND_HALF_BREADTH + reach and gap < MAX_NEIGHBOUR_GAP and ahead > lateral:
            height = _height_class(top_height(other))
            room = HAND_HALF_WIDTH if top_height(other) > top_height(obj) + PALM_CLEARANCE else FINGERS_HALF_WIDTH
            found.append(Neighbour(height, 2 if gap < NEAR_GAP else 1 if gap < FAR_GAP else 0, room - (ahead - reach)))
    return found


def _path_symbols(scene: Scene, obj: SceneObject, end: PathEnd, *, values: bool) -> str:
    """The path from `obj` to an end: the greatest height class on it, and whether an obstacle is above it."""
    height = max((_height_class(top_height(other)) for other in objects_on_path(scene, obj, end)), default=0)
    symbols = [f"path_max_height {HEIGHTS[height]}"]
    if overhead_objects_on_path(scene, obj, end):
        symbols += ["overhead over_path"]
        symbols += ["over_object"] if values and is_below_overhead_object(scene, np.asarray(obj.pose.position)) else []
        symbols += ["over_end"] if values and is_below_overhead_object(scene, end.position) else []
    symbols += [f"clearance {path_clearance(scene, obj, end):g}"] if values else []
    return ", ".join(symbols)


def _person_state(scene: Scene) -> str:
    people = [obj for obj in scene.objects if obj.role == "person"]
    if not people:
        return "none"
    return "crossing" if any(float(np.linalg.norm(obj.velocity)) > 0.02 for obj in people) else "near"


def _height_class(height: float) -> int:
    """Index into `HEIGHTS`."""
    return 1 if height < LOW_HEIGHT else 2 if height < HAND_HEIGHT else 3


def _is_near_edge(scene: Scene, obj: SceneObject) -> bool:
    """Whether the centre of `obj` is within `EDGE_DISTANCE` of the edge of its furniture or of the table.

    The table extends over x from −0.20 to 0.95 m and y from −0.65 to 0.65 m.
    """
    x, y, _ = obj.pose.position
    support = _supporting_furniture(scene, obj)
    if support is not None:
        assert isinstance(support.shape, Box)
        rotation = quaternion_to_matrix(support.pose.quaternion)[:2, :2]
        local = (np.array([x, y]) - np.asarray(support.pose.position)[:2]) @ rotation
        return bool(np.min(np.asarray(support.shape.half_extents)[:2] - np.abs(local)) < EDGE_DISTANCE)
    return bool(min(0.95 - x, x + 0.20, 0.65 - y, y + 0.65) < EDGE_DISTANCE)
