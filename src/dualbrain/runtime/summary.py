"""The scene in symbols: classes computed locally, in each target's own frame, because a small model cannot compare numbers.

The symbols are those that decide the best contract: what stands beside a thing on the finger axis and across it (height
class, gap class), what stands or hangs on the way to a container, and where people are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dualbrain.linalg import matrix
from dualbrain.records import Bowl, Box, Capsule, Cylinder, HalfSpace, Scene, SceneObject, Sphere
from dualbrain.skills.geometry import bottom, finger_direction, top, width

Array = NDArray[np.float64]

LOW, HAND_HIGH = 0.09, 0.13
"""Below the first height [m] a neighbour stays under the hand; above the second it is tall."""
NEAR, FAR = 0.03, 0.06
"""Bounds of the gap classes [m]."""
BESIDE = 0.12
"""Gaps wider than this [m] are no neighbours."""
PATH_WIDTH = 0.10
"""Things within this distance of the straight path count as standing on it [m]."""
OVERHEAD = 0.25
"""Fixed things whose lowest point is higher than this hang over the path [m]."""


def summarise(scene: Scene, holding: str | None = None) -> str:
    """What the planner is told of `scene`: one line a thing, a path, a person; symbols only."""
    lines = [f"robot {scene.robot}; holding {holding or 'nothing'}"]
    lines += [_object_line(scene, thing) for thing in scene.objects if thing.role == "object"]
    lines += [f"{thing.name}: container" for thing in scene.objects if thing.role == "container"]
    lines += _path_lines(scene)
    lines.append(f"person: {_person(scene)}")
    if scene.places:
        lines.append("places: " + ", ".join(place.name for place in scene.places))
    return "\n".join(lines)


def _object_line(scene: Scene, thing: SceneObject) -> str:
    on_axis = _neighbour(scene, thing, finger_direction(thing, "along"), width(thing, "along"))
    across = _neighbour(scene, thing, finger_direction(thing, "across"), width(thing, "across"))
    words = [f"neighbour_on_finger_axis {on_axis}", f"neighbour_across {across}"]
    if _near_edge(scene, thing):
        words.append("near_edge")
    if thing.fragile_limit is not None:
        words.append("fragile")
    return f"{thing.name}: object, " + ", ".join(words)


def _neighbour(scene: Scene, thing: SceneObject, direction: Array, extent: float) -> str:
    """Class of the closest standing thing within 45° of the line through `thing` along `direction`."""
    centre = np.asarray(thing.pose.position)[:2]
    gaps: list[tuple[float, float]] = []
    for other in _standing(scene, thing.name):
        offset = np.asarray(other.pose.position)[:2] - centre
        distance = float(np.linalg.norm(offset))
        if distance > 1e-6 and abs(float(offset @ direction[:2])) >= 0.7 * distance:
            gaps.append((distance - extent / 2 - _reach(other), top(other)))
    gaps = [pair for pair in gaps if pair[0] < BESIDE]
    if not gaps:
        return "none"
    gap, height = min(gaps)
    return f"{_height_class(height)} {'<3cm' if gap < NEAR else '3-6cm' if gap < FAR else '>6cm'}"


def _path_lines(scene: Scene) -> list[str]:
    lines: list[str] = []
    for container in (thing for thing in scene.objects if thing.role == "container"):
        for thing in (thing for thing in scene.objects if thing.role == "object"):
            start, end = (np.asarray(end.pose.position)[:2] for end in (thing, container))
            on_path = [
                other for other in _standing(scene, thing.name, container.name) if _off(start, end, other) < PATH_WIDTH
            ]
            overhead = [other for other in _hanging(scene) if _off(start, end, other) < PATH_WIDTH]
            height = max((top(other) for other in on_path), default=0.0)
            lines.append(
                f"path {thing.name} -> {container.name}: path_max_height {_height_class(height) if on_path else 'none'}, "
                f"path_blocked_direct {'yes' if height >= HAND_HIGH else 'no'}, "
                f"overhead {'over_path' if overhead else 'none'}"
            )
    return lines


def _person(scene: Scene) -> str:
    people = [thing for thing in scene.objects if thing.role == "person"]
    if not people:
        return "none"
    return "crossing" if any(float(np.linalg.norm(thing.velocity)) > 0.02 for thing in people) else "near"


def _standing(scene: Scene, *without: str) -> list[SceneObject]:
    kinds = ("object", "container", "obstacle")
    return [
        thing
        for thing in scene.objects
        if thing.role in kinds and thing.name not in without and bottom(thing) < OVERHEAD
    ]


def _hanging(scene: Scene) -> list[SceneObject]:
    return [thing for thing in scene.objects if thing.role == "obstacle" and bottom(thing) >= OVERHEAD]


def _height_class(height: float) -> str:
    return "low" if height < LOW else "hand_high" if height < HAND_HIGH else "tall"


def _reach(thing: SceneObject) -> float:
    """Radius of the disc that covers the thing's footprint [m]."""
    match thing.shape:
        case Sphere(radius) | Cylinder(radius, _) | Bowl(radius, _, _):
            return radius
        case Box(half_extents):
            return float(np.hypot(half_extents[0], half_extents[1]))
        case Capsule(radius, half_length):
            return radius + half_length * float(np.linalg.norm(matrix(thing.pose.quaternion)[:2, 2]))
        case HalfSpace():
            return 0.0


def _off(start: Array, end: Array, thing: SceneObject) -> float:
    """Distance in the plane from the footprint of `thing` to the segment start–end [m]."""
    centre = np.asarray(thing.pose.position)[:2]
    line = end - start
    along = float(np.clip((centre - start) @ line / (line @ line + 1e-12), 0.0, 1.0))
    return max(0.0, float(np.linalg.norm(centre - start - along * line)) - _reach(thing))


def _near_edge(scene: Scene, thing: SceneObject) -> bool:
    """Whether the thing's middle is within 6 cm of the edge of the table (x −0.20 … 0.95 m, y ±0.65 m)."""
    del scene
    x, y, _ = thing.pose.position
    return bool(min(0.95 - x, x + 0.20, 0.65 - y, y + 0.65) < 0.06)
