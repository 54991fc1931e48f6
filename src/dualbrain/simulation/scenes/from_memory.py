"""Rebuilds a simulated scene from a perceived scene in memory, to replay a past episode in simulation."""

from __future__ import annotations

from math import atan2

import numpy as np

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, HalfSpace, Shape, Sphere
from dualbrain.records import Scene, SceneObject
from dualbrain.simulation.scenes.scene_spec import (
    KEEP_OUT_CATEGORY,
    FloorMap,
    KeepOutArea,
    MovingPerson,
    ObjectSpec,
    SceneSpec,
    check_scene,
)

ASSUMED_DENSITY = 400.0
"""Assumed density of objects [kg/m³]; perception and memory do not know their mass."""
MIN_MASS, MAX_MASS = 0.02, 0.5
TABLE_TOLERANCE = 0.02
"""An object whose bottom is within this distance of the table top is on the table [m]."""
INITIAL_CLEARANCE = 0.0005
"""Initial distance between an object and its support [m]."""
MIN_MOVING_SPEED, CROSSING_DURATION = 0.02, 3.0
"""A person faster than the first [m/s] is simulated as crossing, for the second [s] in each direction."""


def scene_from_memory(scene: Scene, rng: np.random.Generator, *, position_spread: float) -> SceneSpec:
    """A simulated scene for the perceived `scene`.

    Every free object is shifted along x and y by a normal error with standard deviation `position_spread` [m]. Masses,
    friction and objects that were not perceived are unknown, so that the result of one replay is weak evidence; use
    several replays with different shifts. Raises `ConfigurationError` for a scene that cannot be simulated.
    """
    closed = tuple(_keep_out_area(obj) for obj in scene.objects if obj.category == KEEP_OUT_CATEGORY)
    simulated = [obj for obj in scene.objects if _is_simulated(obj)]
    objects = tuple(
        _object_spec(obj, rng.normal(0.0, position_spread, 2), room=bool(scene.region)) for obj in simulated
    )
    people = [obj for obj in scene.objects if obj.role == "person" and isinstance(obj.shape, Capsule)]
    mover = _moving_person(people[0]) if people else None
    chart = FloorMap(scene.region, closed) if closed else None
    spec = SceneSpec(
        robot=scene.robot,
        family="remembered",
        seed=0,
        objects=objects,
        places=scene.places,
        mover=mover,
        region=scene.region,
        chart=chart,
    )
    check_scene(spec)
    return spec


def _is_simulated(obj: SceneObject) -> bool:
    """Whether an object becomes a body: not a person, not an unbounded table top or floor, not a keep-out area."""
    return obj.role != "person" and not isinstance(obj.shape, HalfSpace) and obj.category != KEEP_OUT_CATEGORY


def _keep_out_area(obj: SceneObject) -> KeepOutArea:
    """The keep-out area of the floor that an object of category keep_out represents."""
    assert isinstance(obj.shape, Box)
    (x, y, _), (a, b, _) = obj.pose.position, obj.shape.half_extents
    w, _, _, z = obj.pose.quaternion
    return KeepOutArea(obj.name, (x, y), (a, b), 2.0 * atan2(z, w))


def _object_spec(obj: SceneObject, shift: np.ndarray, *, room: bool) -> ObjectSpec:
    """The simulated object; in a `room`, obstacles and supports are fixed, because their mass is unknown."""
    fixed = (room and obj.role in ("obstacle", "support")) or (
        obj.role == "obstacle" and _bottom_height(obj) > TABLE_TOLERANCE
    )
    x, y, z = obj.pose.position
    if not fixed:
        x, y = x + float(shift[0]), y + float(shift[1])
        z = z - _bottom_height(obj) + INITIAL_CLEARANCE if abs(_bottom_height(obj)) < TABLE_TOLERANCE else z
    mass = float(np.clip(ASSUMED_DENSITY * _volume(obj.shape), MIN_MASS, MAX_MASS))
    return ObjectSpec(
        name=obj.name,
        role=obj.role,
        shape=obj.shape,
        position=(x, y, z),
        mass=mass,
        colour=obj.colour,
        category=obj.category,
        quaternion=obj.pose.quaternion,
        fragile_limit=obj.fragile_limit,
        fixed=fixed,
    )


def _moving_person(person: SceneObject) -> MovingPerson:
    """A person who walks back and forth with the perceived velocity, or rests if it is below `MIN_MOVING_SPEED`."""
    start, velocity = np.asarray(person.pose.position), np.asarray(person.velocity)
    speed = float(np.linalg.norm(velocity))
    assert isinstance(person.shape, Capsule)
    end = start + velocity * CROSSING_DURATION if speed > MIN_MOVING_SPEED else start + np.array([0.0, 0.001, 0.0])
    pause = 0.0 if speed > MIN_MOVING_SPEED else 1e6
    a, b, axis = (_to_vector(v) for v in (start, end, quaternion_to_matrix(person.pose.quaternion)[:, 2]))
    shape = person.shape
    return MovingPerson(
        start=a,
        end=b,
        speed=max(speed, 0.01),
        pause=pause,
        phase=0.0,
        name=person.name,
        radius=shape.radius,
        half_length=shape.half_length,
        axis=axis,
    )


def _to_vector(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def _bottom_height(obj: SceneObject) -> float:
    """Height of the lowest point of an upright object [m]."""
    z = obj.pose.position[2]
    match obj.shape:
        case Bowl():
            return z
        case Cylinder(_, half_height):
            return z - half_height
        case Box(half_extents):
            return z - half_extents[2]
        case Sphere(radius):
            return z - radius
        case _:
            return z


def _volume(shape: Shape) -> float:
    """Volume of the material of a shape [m³]."""
    match shape:
        case Sphere(radius):
            return 4.19 * radius**3
        case Cylinder(radius, half_height):
            return 2.0 * np.pi * radius**2 * half_height
        case Box((a, b, c)):
            return 8.0 * a * b * c
        case Bowl(radius, height, wall):
            return (np.pi * radius**2 + 2.0 * np.pi * radius * height) * wall
        case _:
            return 0.0
