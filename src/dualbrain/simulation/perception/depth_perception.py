"""Depth perception: the scene from rendered RGB-D images, by clustering points and fitting primitives.

The simulator's ground truth about objects is not used: positions, sizes, orientations and heights are fitted, and names
are composed of the colour and the category that a shape suggests (`red_cube`, `white_bottle`). Known in advance are the
calibration of the cameras, the robot model, the table, and the objects fixed to the room (a site's map). People are not
detected; scenes with a person are rejected.

Every object is in view before the robot moves; later the arm occludes some. An object that is not visible, or only
partly visible, keeps its last pose. While both finger pads measure a grip force, the held object moves with the tool.
"""

from __future__ import annotations

from collections.abc import Collection

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
"""Bound of a fitted surface's error [m]: about twice the worst that was measured (docs/explanation/tasks.md)."""
CAPTURE_PERIOD = 0.5
"""Time between two images [s]; in between, the scene is that of the last image."""
MIN_VISIBLE_SHARE, MAX_SIZE_CHANGE = 0.8, 0.002
"""An object counts as fully visible if it shows at least this share of the points of its first fit, and its size
differs from the first fit by less than this [m]. The fit of a partly occluded object is too small and off-centre."""
MIN_GRIP_FORCE, MAX_GRASP_DISTANCE = 0.5, 0.05
"""An object is held if both finger pads measure more than this [N] and its centre is within this of the tool [m]."""
MAP_TOLERANCE = 0.015
"""Points within this distance of an object fixed to the room belong to that object [m]."""
FRAGILE_LIMITS = {"glass": 10.0}
"""Categories that are assumed fragile, and the force [N] above which they break; images do not show it."""
LOW_HEIGHT, HIGH_HEIGHT = 0.07, 0.13
"""Heights that separate tin, can and bottle, and block, carton and box [m]."""


class DepthPerception:
    """A perception model that builds a `Scene` from depth images of a plant; close it at the end."""

    def __init__(self, spec: SceneSpec, camera: DepthCamera) -> None:
        """Perceive `spec` through `camera`; raises `ConfigurationError` for a scene with a person or a room."""
        if not spec.supports_depth_perception:
            sentence = f"Depth perception supports only tables without people, not scene {spec.family}."
            raise ConfigurationError.stating(sentence, fix="Choose another scene or perception model.")
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
        """The scene as perceived now; `stamp` of each object is the time of its last observation [s]."""
        now = plant.now
        self._update_held(plant, now)
        if now - self._last_capture > CAPTURE_PERIOD - 1e-9:
            self._last_capture = now
            self._update_from_image(now)
        support = msgspec.structs.replace(TABLE_OBJECT, stamp=now)
        fixed = (msgspec.structs.replace(obj, stamp=now) for obj in self._fixed_objects)
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
        """Take one image: the first one names the objects, later ones update those that are fully visible."""
        points, colours = self._camera.capture_points(min_height=MIN_POINT_HEIGHT)
        keep = np.ones(len(points), bool)
        for obj in self._fixed_objects:
            keep &= signed_distance(*bounding_solid(obj.shape, obj.pose), points) > MAP_TOLERANCE
        found = fit_primitives(points[keep], colours[keep])
        if not self._seen:
            fixed = {one.name for one in (*self._fixed_objects, *self._places)}
            for one in found:
                obj = _to_scene_object(one, fixed.union(self._seen), now)
                self._seen[obj.name], self._first_fits[obj.name] = obj, one
            return
        for name, old in self._seen.items():
            same = [one for one in found if _may_be_same(one, old) and _is_fully_visible(one, self._first_fits[name])]
            if same and (self._held is None or self._held[0] != name):
                nearest = min(same, key=lambda one: _planar_distance(one.pose, old.pose))
                self._seen[name] = msgspec.structs.replace(old, pose=nearest.pose, shape=nearest.shape, stamp=now)

    def _update_held(self, plant: Plant, now: float) -> None:
        """Move the held object with the tool."""
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
            obj = min(near, key=lambda t: float(np.linalg.norm(np.subtract(t.pose.position, position))))
            offset = rotation.T @ np.subtract(obj.pose.position, position)
            self._held = (obj.name, offset, rotation.T @ quaternion_to_matrix(obj.pose.quaternion))
        name, offset, turn = self._held
        x, y, z = (position + rotation @ offset).tolist()
        pose = Pose((x, y, z), matrix_to_quaternion(rotation @ turn))
        if pose != self._seen[name].pose:
            self._seen[name] = msgspec.structs.replace(self._seen[name], pose=pose, stamp=now)


def _is_gripping(plant: Plant) -> bool:
    """Whether the sensors of both finger pads measure a grip force."""
    return min(plant.pad_forces()) > MIN_GRIP_FORCE


def _to_scene_object(one: Primitive, taken: Collection[str], now: float) -> SceneObject:
    """The object that a primitive represents; its name is numbered if it is among the `taken` ones."""
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
    """The category of an object with the shape and colour of `one`, such as "cube" or "bottle"."""
    if isinstance(one.shape, Bowl):
        return "bowl"
    if isinstance(one.shape, Cylinder):
        return "glass" if one.colour == "clear" else ("tin", "can", "bottle")[_height_class(2 * one.shape.half_height)]
    return "cube" if one.colour == "red" else ("block", "carton", "box")[_height_class(2 * one.shape.half_extents[2])]


def _height_class(height: float) -> int:
    return 0 if height < LOW_HEIGHT else 1 if height < HIGH_HEIGHT else 2


def _may_be_same(one: Primitive, old: SceneObject) -> bool:
    """Whether a primitive may be the known object `old`: same colour, same shape type, less than 10 cm away."""
    return (
        one.colour == old.colour and type(one.shape) is type(old.shape) and _planar_distance(one.pose, old.pose) < 0.10
    )


def _is_fully_visible(one: Primitive, first: Primitive) -> bool:
    """Whether as much of an object is visible now as in its `first` fit."""
    smaller = np.subtract(_sizes(first), _sizes(one))
    return one.n_points > MIN_VISIBLE_SHARE * first.n_points and float(np.abs(smaller).max()) < MAX_SIZE_CHANGE


def _sizes(one: Primitive) -> tuple[float, ...]:
    """Dimensions of a shape [m], independent of its yaw."""
    match one.shape:
        case Box(half_extents=(a, b, height)):
            return (min(a, b), max(a, b), height)
        case Cylinder(radius, height) | Bowl(radius, height):
            return (radius, height)


def _planar_distance(one: Pose, other: Pose) -> float:
    return float(np.linalg.norm(np.subtract(one.position[:2], other.position[:2])))
