"""The scene in symbols, computed locally in each target's own frame: a small model cannot compare numbers.

The symbols are those that decide the best contract: what stands beside a thing on the finger axis and across it (height
class, gap class), what stands or hangs on the way to a container, and where people are.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, HalfSpace, Pose, Sphere
from dualbrain.records import Place, Scene, SceneObject
from dualbrain.skills.kinematics.object_geometry import bottom_height, finger_direction, grasp_width, top_height

Array = NDArray[np.float64]

LOW_HEIGHT, HAND_HEIGHT = 0.09, 0.13
"""Below the first height [m] a neighbour stays under the hand; above the second it is tall."""
NEAR_GAP, FAR_GAP = 0.03, 0.06
"""Bounds of the gap classes [m]."""
MAX_NEIGHBOUR_GAP = 0.12
"""Gaps wider than this [m] are no neighbours."""
PATH_WIDTH = 0.10
"""Things within this distance of the straight path count as standing on it [m]."""
EDGE_DISTANCE = 0.06
"""Nearer than this to the edge of what it stands on, a thing is near the edge [m]."""
SUPPORT_TOLERANCE, FURNITURE_REACH = 0.05, 0.7
"""A thing stands on furniture if its bottom is that near to the top; a place is at furniture within the second [m]."""
AISLE_PREFIX, AISLE_RADIUS = "aisle_", 1.2
"""How places in aisles are called, and how near to one somebody is in that aisle [m]."""
OVERHEAD_HEIGHT = 0.25
"""Fixed things whose lowest point is higher than this hang over the path [m]."""


def summarise_scene(scene: Scene, holding: str | None = None) -> str:
    """What the planner is told of `scene`: one line a thing, a path, a person; symbols only.

    Of a room in which things stand on furniture, also from which place they can be reached, and where to look there.
    """
    if scene.region:
        return _summarise_workroom(scene, holding) if _furniture(scene) else _summarise_room(scene)
    lines = [f"robot {scene.robot}; holding {holding or 'nothing'}"]
    lines += [_object_line(scene, thing) for thing in scene.objects if thing.role == "object"]
    containers = (thing for thing in scene.objects if thing.role == "container")
    lines += [f"{thing.name}: container{_contents_suffix(scene, thing)}" for thing in containers]
    lines.append(f"person: {_person_state(scene)}")
    if scene.places:
        lines.append(_places_line(scene))
    return "\n".join(lines)


def _places_line(scene: Scene) -> str:
    return "places: " + ", ".join(place.name for place in scene.places)


def _standing_line(scene: Scene, roles: tuple[str, ...]) -> str:
    standing = ", ".join(thing.name for thing in scene.objects if thing.role in roles)
    return f"standing about: {standing or 'nothing'}"


def _contents_suffix(scene: Scene, container: SceneObject) -> str:
    """What lies in a container; nothing is said of one that is free."""
    bowl = container.shape
    if not isinstance(bowl, Bowl):
        return ""
    x, y, z = container.pose.position
    lying = [
        thing.name
        for thing in scene.objects
        if thing.role == "object"
        and np.hypot(thing.pose.position[0] - x, thing.pose.position[1] - y) < bowl.radius - bowl.wall
        and 0.0 < thing.pose.position[2] - z < bowl.height + 0.01
    ]
    return f", holds {' and '.join(lying)}" if lying else ""


def _summarise_room(scene: Scene) -> str:
    """A room as a base is told of it: where it can go, what stands about, and people."""
    lines = [f"robot {scene.robot}", _places_line(scene), _standing_line(scene, ("object", "obstacle", "container"))]
    aisles = ", ".join(f"{place.name} {_aisle_state(scene, place)}" for place in scene.places if _is_aisle(place))
    return "\n".join([*lines, *([f"aisles: {aisles}"] if aisles else []), f"person: {_person_state(scene)}"])


def _furniture(scene: Scene) -> list[SceneObject]:
    """What things stand on in a room."""
    return [thing for thing in scene.objects if thing.role == "support" and isinstance(thing.shape, Box)]


def _summarise_workroom(scene: Scene, holding: str | None) -> str:
    """A room as an arm on a base is told of it."""
    before = {thing.name: _work_pose(scene, thing) for thing in _furniture(scene)}
    lines = [f"robot {scene.robot}; holding {holding or 'nothing'}", _places_line(scene)]
    lines += [f"{at.place}: before {name}, heading {at.heading:.2f}" for name, at in before.items() if at]
    for thing in scene.objects:
        if thing.role not in ("object", "container") or thing.name == holding:
            continue
        carrier = _supporting_furniture(scene, thing)
        at = before[carrier.name] if carrier else None
        where = f", at {at.place}" if at else ""
        if thing.role == "container":
            lines.append(f"{thing.name}: container{where}{_contents_suffix(scene, thing)}")
        else:
            seen = _relative_to_height(scene, top_height(carrier)) if carrier else scene
            line = _object_line(seen, seen.find(thing.name))
            lines.append(line.replace(": object", f": object{where}", 1))
    return "\n".join([*lines, _standing_line(scene, ("obstacle",)), f"person: {_person_state(scene)}"])


class WorkPose(NamedTuple):
    """A place from which a piece of furniture can be worked at, and the heading [rad] that looks at it from there."""

    place: str
    heading: float


def _work_pose(scene: Scene, furniture: SceneObject) -> WorkPose | None:
    """The place nearest to `furniture`, if it is within an arm's reach of its edge."""
    gaps = {place.name: _vector_to_edge(furniture, np.asarray(place.position)) for place in scene.places}
    name = min(gaps, key=lambda name: float(np.linalg.norm(gaps[name])), default=None)
    if name is None or float(np.linalg.norm(gaps[name])) > FURNITURE_REACH:
        return None
    x, y = gaps[name]
    return WorkPose(name, float(np.arctan2(y, x)))


def _vector_to_edge(furniture: SceneObject, spot: Array) -> Array:
    """From `spot` to the nearest point of the outline of `furniture` (2,) [m]."""
    assert isinstance(furniture.shape, Box)
    turn, half = quaternion_to_matrix(furniture.pose.quaternion)[:2, :2], np.asarray(furniture.shape.half_extents)[:2]
    middle = np.asarray(furniture.pose.position)[:2]
    inside = (spot[:2] - middle) @ turn
    return turn @ (np.clip(inside, -half, half) - inside)


def _supporting_furniture(scene: Scene, thing: SceneObject) -> SceneObject | None:
    """The furniture that `thing` stands on."""
    return next(
        (
            one
            for one in _furniture(scene)
            if abs(bottom_height(thing) - top_height(one)) < SUPPORT_TOLERANCE
            and not np.any(_vector_to_edge(one, np.asarray(thing.pose.position)))
        ),
        None,
    )


def _relative_to_height(scene: Scene, height: float) -> Scene:
    """The scene as seen from a frame at `height` [m], as an arm sees its table."""

    def down(thing: SceneObject) -> SceneObject:
        x, y, z = thing.pose.position
        return msgspec.structs.replace(thing, pose=Pose((x, y, z - height), thing.pose.quaternion))

    return msgspec.structs.replace(scene, objects=tuple(down(thing) for thing in scene.objects))


def _is_aisle(place: Place) -> bool:
    return place.name.startswith(AISLE_PREFIX)


def _aisle_state(scene: Scene, place: Place) -> str:
    """occupied: somebody is in it; narrow: things lie in it that are not part of the room; else free."""
    middle = np.asarray(place.position)[:2]
    inside = [
        thing for thing in scene.objects if np.linalg.norm(np.asarray(thing.pose.position)[:2] - middle) < AISLE_RADIUS
    ]
    roles = {thing.role for thing in inside}
    return "occupied" if "person" in roles else "narrow" if "object" in roles else "free"


def _object_line(scene: Scene, thing: SceneObject) -> str:
    """One line: the freer axis for the fingers, neighbours in the thing's own frame, the way to each container."""
    beside = {axis: _neighbours(scene, thing, axis) for axis in ("along", "across")}
    crowd = {axis: max((one.overlap for one in beside[axis]), default=-1.0) for axis in beside}
    free = min(crowd, key=lambda axis: crowd[axis])
    words = ["object", f"free_finger_axis {free}"] + (["tight"] if crowd[free] > TIGHT_OVERLAP else [])
    words += [f"neighbour_{axis} {max(found, key=lambda one: one.overlap)}" for axis, found in beside.items() if found]
    words += ["near_edge"] if _is_near_edge(scene, thing) else []
    words += ["fragile"] if thing.fragile_limit is not None else []
    words += [_path_symbols(scene, thing, end) for end in _path_ends(scene)]
    return f"{thing.name}: " + ", ".join(words)


class Neighbour(NamedTuple):
    """What stands beside a thing: height class, gap class, and how far it reaches into the room of the hand [m]."""

    height: int
    gap: int
    overlap: float

    def __str__(self) -> str:
        """For the planner, such as "tall 3-6cm"."""
        return f"{HEIGHTS[self.height]} {GAPS[self.gap]}"


HEIGHTS = ("none", "low", "hand_high", "tall")
GAPS = (">6cm", "3-6cm", "<3cm")
HAND_HALF_WIDTH, FINGERS_HALF_WIDTH = 0.125, 0.065
"""Room that the palm, and below it the open fingers, take along the finger axis from the middle, with margins [m]."""
PALM_CLEARANCE = 0.005
"""What is this much higher than the thing in the hand meets the palm, not only the fingers [m]."""
HAND_HALF_BREADTH = 0.04
"""Room that the hand takes to either side of the finger axis [m]."""
TIGHT_OVERLAP = -0.01
"""An overlap above this leaves the hand no air on that axis [m]."""


def _neighbours(scene: Scene, thing: SceneObject, axis: str) -> list[Neighbour]:
    """Standing things in the strip that a hand needs when its fingers close along `axis` of `thing`."""
    centre, direction = np.asarray(thing.pose.position)[:2], finger_direction(thing, axis)[:2]
    found: list[Neighbour] = []
    for other in _standing_objects(scene, thing.name):
        offset, reach = np.asarray(other.pose.position)[:2] - centre, _footprint_radius(other)
        ahead, aside = abs(float(offset @ direction)), abs(float(direction[0] * offset[1] - direction[1] * offset[0]))
        gap = ahead - grasp_width(thing, axis) / 2 - reach
        if aside < HAND_HALF_BREADTH + reach and gap < MAX_NEIGHBOUR_GAP and ahead > aside:
            height = _height_class(top_height(other))
            room = HAND_HALF_WIDTH if top_height(other) > top_height(thing) + PALM_CLEARANCE else FINGERS_HALF_WIDTH
            found.append(Neighbour(height, 2 if gap < NEAR_GAP else 1 if gap < FAR_GAP else 0, room - (ahead - reach)))
    return found


def _path_ends(scene: Scene) -> list[tuple[str, Array]]:
    """Where ways lead to, by name: every container; in a scene without one its place, if it has but one."""
    containers = [(thing.name, np.asarray(thing.pose.position)) for thing in scene.objects if thing.role == "container"]
    places = [(place.name, np.asarray(place.position)) for place in scene.places]
    return containers or (places if len(places) == 1 else [])


def _path_symbols(scene: Scene, thing: SceneObject, to: tuple[str, Array]) -> str:
    """The way from `thing` to an end: how high things stand on it, and whether something hangs over it."""
    start, end = np.asarray(thing.pose.position)[:2], to[1][:2]
    on_path = [
        other
        for other in _standing_objects(scene, thing.name, to[0])
        if _distance_to_segment(start, end, other) < PATH_WIDTH
    ]
    height = max((_height_class(top_height(other)) for other in on_path), default=0)
    overhead = any(_distance_to_segment(start, end, other) < PATH_WIDTH for other in _overhead_objects(scene))
    return f"path_max_height {HEIGHTS[height]}" + (", overhead over_path" if overhead else "")


def _person_state(scene: Scene) -> str:
    people = [thing for thing in scene.objects if thing.role == "person"]
    if not people:
        return "none"
    return "crossing" if any(float(np.linalg.norm(thing.velocity)) > 0.02 for thing in people) else "near"


def _standing_objects(scene: Scene, *without: str) -> list[SceneObject]:
    kinds = ("object", "container", "obstacle")
    return [
        thing
        for thing in scene.objects
        if thing.role in kinds and thing.name not in without and bottom_height(thing) < OVERHEAD_HEIGHT
    ]


def _overhead_objects(scene: Scene) -> list[SceneObject]:
    return [thing for thing in scene.objects if thing.role == "obstacle" and bottom_height(thing) >= OVERHEAD_HEIGHT]


def _height_class(height: float) -> int:
    """Index into `HEIGHTS`."""
    return 1 if height < LOW_HEIGHT else 2 if height < HAND_HEIGHT else 3


def _footprint_radius(thing: SceneObject) -> float:
    """Radius of the disc that covers the thing's footprint [m]."""
    match thing.shape:
        case Sphere(radius) | Cylinder(radius, _) | Bowl(radius, _, _):
            return radius
        case Box(half_extents):
            return float(np.hypot(half_extents[0], half_extents[1]))
        case Capsule(radius, half_length):
            return radius + half_length * float(np.linalg.norm(quaternion_to_matrix(thing.pose.quaternion)[:2, 2]))
        case HalfSpace():
            return 0.0


def _distance_to_segment(start: Array, end: Array, thing: SceneObject) -> float:
    """Distance in the plane from the footprint of `thing` to the segment start–end [m]."""
    centre = np.asarray(thing.pose.position)[:2]
    line = end - start
    along = float(np.clip((centre - start) @ line / (line @ line + 1e-12), 0.0, 1.0))
    return max(0.0, float(np.linalg.norm(centre - start - along * line)) - _footprint_radius(thing))


def _is_near_edge(scene: Scene, thing: SceneObject) -> bool:
    """Whether the thing's middle is within 6 cm of the edge of the table (x −0.20 … 0.95 m, y ±0.65 m) or furniture."""
    x, y, _ = thing.pose.position
    under = _supporting_furniture(scene, thing)
    if under is not None:
        assert isinstance(under.shape, Box)
        turn = quaternion_to_matrix(under.pose.quaternion)[:2, :2]
        inside = (np.array([x, y]) - np.asarray(under.pose.position)[:2]) @ turn
        return bool(np.min(np.asarray(under.shape.half_extents)[:2] - np.abs(inside)) < EDGE_DISTANCE)
    return bool(min(0.95 - x, x + 0.20, 0.65 - y, y + 0.65) < EDGE_DISTANCE)
