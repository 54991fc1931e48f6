"""Perception without an oracle: the scene from rendered RGB-D by clustering depth and fitting primitives.

Nothing of the simulator's knowledge of things enters: positions, sizes, turns and heights are fitted, names are made
of the colour and the kind that a shape looks like (`red_cube`, `white_bottle`). Known beforehand are the cameras'
calibration, the robot's own body, the table, and what is fixed to the room (a site's map). People are not seen this
way: scenes with a person are refused.

Before the robot has moved everything is in view; later the arm hides things. A thing that is not seen, or not whole,
stays where it was seen last. What the fingers feel between them moves with the hand until they let go of it; a hand
that rests feels nothing new.
"""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.distance import bounding_solid, signed_distance
from dualbrain.core.geometry.rotations import matrix_to_quaternion, quaternion_to_matrix
from dualbrain.core.geometry.shapes import Bowl, Box, Cylinder, Pose
from dualbrain.errors import ConfigurationError
from dualbrain.records import Scene, SceneObject
from dualbrain.simulation.perception.depth_camera import DepthCamera
from dualbrain.simulation.perception.noisy_perception import TABLE_OBJECT
from dualbrain.simulation.perception.primitive_fitting import MIN_POINT_HEIGHT, Primitive, fit_primitives
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_spec import SceneSpec

Array = NDArray[np.float64]
SURFACE_ERROR_BOUND = 0.004
"""Bound of a fitted surface's error [m]: about twice the worst that was measured (docs/tasks.md)."""
CAPTURE_PERIOD = 0.5
"""A picture is taken this often [s]; between two the scene is what was seen last."""
MIN_VISIBLE_SHARE, MAX_SIZE_CHANGE = 0.8, 0.002
"""A thing is believed seen whole when it shows this share of the points that it showed first, and is as large as then
but for this [m]: of what the arm hides in part a smaller shape is fitted, and its middle is wrong by as much again."""
MIN_GRIP_FORCE, MAX_GRASP_DISTANCE = 0.5, 0.05
"""Both fingers feel more than this [N], and the middle of the thing is this near to the tool [m]: it is held."""
MAP_TOLERANCE = 0.015
"""Points this near to what is fixed to the room are of that [m]."""
FRAGILE_LIMITS = {"glass": 10.0}
"""Kinds of things that are taken to break, and above which force [N]; eyes cannot tell it."""
LOW_HEIGHT, HIGH_HEIGHT = 0.07, 0.13
"""Heights that part tins from cans from bottles, and blocks from cartons from boxes [m]."""


class DepthPerception:
    """Looks at a plant and tells a `Scene`, as `Perception` does; close it at the end."""

    def __init__(self, spec: SceneSpec, camera: DepthCamera) -> None:
        """Perception through `camera`; raises `InvalidSetup` for a scene with a person or a room to drive in."""
        if not spec.supports_depth_perception:
            raise ConfigurationError("scene for depth perception", got=spec.family, allowed="a table without people")
        self._robot, self._places, self._camera = spec.robot, spec.places, camera
        self._fixed_objects = tuple(
            SceneObject(
                name=t.name,
                role=t.role,
                shape=t.shape,
                pose=Pose(t.position, t.quaternion),
                category=t.category,
                colour=t.colour,
            )
            for t in spec.objects
            if t.fixed
        )
        self._seen: dict[str, SceneObject] = {}
        self._first_fits: dict[str, Primitive] = {}
        self._last_capture = -np.inf
        self._held: tuple[str, Array, Array] | None = None

    def perceive(self, plant: Plant) -> Scene:
        """The scene as perceived now; each object's `stamp` says when it was really seen."""
        now = plant.now
        self._update_held(plant, now)
        if now - self._last_capture > CAPTURE_PERIOD - 1e-9:
            self._last_capture = now
            self._update_from_image(now)
        support = msgspec.structs.replace(TABLE_OBJECT, stamp=now)
        fixed = (msgspec.structs.replace(thing, stamp=now) for thing in self._fixed_objects)
        return Scene(
            robot=self._robot,
            stamp=now,
            version=1,
            objects=(support, *self._seen.values(), *fixed),
            places=self._places,
        )

    def close(self) -> None:
        """Release the camera."""
        self._camera.close()

    def _update_from_image(self, now: float) -> None:
        """One picture: new things are named, known ones that are seen whole and near their place are renewed."""
        points, colours = self._camera.capture_points(min_height=MIN_POINT_HEIGHT)
        keep = np.ones(len(points), bool)
        for thing in self._fixed_objects:
            keep &= signed_distance(*bounding_solid(thing.shape, thing.pose), points) > MAP_TOLERANCE
        found = fit_primitives(points[keep], colours[keep])
        if not self._seen:
            for one in found:
                thing = _to_scene_object(one, self._seen, now)
                self._seen[thing.name], self._first_fits[thing.name] = thing, one
            return
        for name, old in self._seen.items():
            again = [one for one in found if _may_be_same(one, old) and _is_fully_visible(one, self._first_fits[name])]
            if again and (self._held is None or self._held[0] != name):
                nearest = min(again, key=lambda one: _planar_distance(one.pose, old.pose))
                self._seen[name] = msgspec.structs.replace(old, pose=nearest.pose, shape=nearest.shape, stamp=now)

    def _update_held(self, plant: Plant, now: float) -> None:
        """What is felt between the fingers moves with the tool."""
        position, rotation = plant.tool_pose()
        if not _is_gripping(plant):
            self._held = None
            return
        if self._held is None:
            near = [
                t
                for t in self._seen.values()
                if np.linalg.norm(np.subtract(t.pose.position, position)) < MAX_GRASP_DISTANCE
            ]
            if not near:
                return
            thing = min(near, key=lambda t: float(np.linalg.norm(np.subtract(t.pose.position, position))))
            offset = rotation.T @ np.subtract(thing.pose.position, position)
            self._held = (thing.name, offset, rotation.T @ quaternion_to_matrix(thing.pose.quaternion))
        name, offset, turn = self._held
        x, y, z = (position + rotation @ offset).tolist()
        pose = Pose((x, y, z), matrix_to_quaternion(rotation @ turn))
        if pose != self._seen[name].pose:
            self._seen[name] = msgspec.structs.replace(self._seen[name], pose=pose, stamp=now)


def _is_gripping(plant: Plant) -> bool:
    """Whether both fingers feel something, as the robot's own sensors say."""
    return min(plant.pad_forces()) > MIN_GRIP_FORCE


def _to_scene_object(one: Primitive, taken: dict[str, SceneObject], now: float) -> SceneObject:
    """The thing that a primitive looks like; a second one of a name is numbered."""
    category = shape_category(one)
    name = f"{one.colour}_{category}"
    number = 2
    while name in taken:
        name, number = f"{one.colour}_{category}_{number}", number + 1
    role = "container" if isinstance(one.shape, Bowl) else "object"
    return SceneObject(
        name=name,
        role=role,
        shape=one.shape,
        pose=one.pose,
        error=SURFACE_ERROR_BOUND,
        stamp=now,
        category=category,
        colour=one.colour,
        fragile_limit=FRAGILE_LIMITS.get(category),
    )


def shape_category(one: Primitive) -> str:
    """What a thing of that shape and colour is called."""
    if isinstance(one.shape, Bowl):
        return "bowl"
    if isinstance(one.shape, Cylinder):
        return "glass" if one.colour == "clear" else ("tin", "can", "bottle")[_height_class(2 * one.shape.half_height)]
    return "cube" if one.colour == "red" else ("block", "carton", "box")[_height_class(2 * one.shape.half_extents[2])]


def _height_class(height: float) -> int:
    return 0 if height < LOW_HEIGHT else 1 if height < HIGH_HEIGHT else 2


def _may_be_same(one: Primitive, old: SceneObject) -> bool:
    """Whether a primitive may be the thing that was seen before: its colour, its kind, within a hand's breadth."""
    return (
        one.colour == old.colour and type(one.shape) is type(old.shape) and _planar_distance(one.pose, old.pose) < 0.10
    )


def _is_fully_visible(one: Primitive, first: Primitive) -> bool:
    """Whether all that was seen of a thing at `first` is seen now."""
    smaller = np.subtract(_sizes(first), _sizes(one))
    return one.n_points > MIN_VISIBLE_SHARE * first.n_points and float(np.abs(smaller).max()) < MAX_SIZE_CHANGE


def _sizes(one: Primitive) -> tuple[float, ...]:
    """What makes a shape large [m], however it is turned."""
    match one.shape:
        case Box(half_extents=(a, b, height)):
            return (min(a, b), max(a, b), height)
        case Cylinder(radius, height) | Bowl(radius, height):
            return (radius, height)


def _planar_distance(one: Pose, other: Pose) -> float:
    return float(np.linalg.norm(np.subtract(one.position[:2], other.position[:2])))
