"""A world rebuilt from what a robot once perceived: to try again in simulation what was done then."""

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
"""Things weigh this much [kg/m³]: neither perception nor memory knows their mass."""
MIN_MASS, MAX_MASS = 0.02, 0.5
TABLE_TOLERANCE = 0.02
"""What seems to stand this near to the table top stands on it [m]."""
INITIAL_CLEARANCE = 0.0005
"""Things begin this far above what they stand on [m]."""
MIN_MOVING_SPEED, CROSSING_DURATION = 0.02, 3.0
"""A person faster than this [m/s] crosses, going on for this long [s] before turning back."""


def scene_from_memory(scene: Scene, rng: np.random.Generator, *, position_spread: float) -> SceneSpec:
    """The scene as a simulated world, every free thing shifted by a normal error of `spread` [m] along x and y.

    What it is not: masses, friction and what was not perceived are unknown, so that one try proves little; several with
    different shifts are evidence. Raises `InvalidSetup` for a scene that cannot be simulated.
    """
    shut = tuple(_keep_out_area(thing) for thing in scene.objects if thing.category == KEEP_OUT_CATEGORY)
    seen = [thing for thing in scene.objects if _is_simulated(thing)]
    things = tuple(_object_spec(thing, rng.normal(0.0, position_spread, 2), room=bool(scene.region)) for thing in seen)
    people = [thing for thing in scene.objects if thing.role == "person" and isinstance(thing.shape, Capsule)]
    mover = _moving_person(people[0]) if people else None
    chart = FloorMap(scene.region, shut) if shut else None
    spec = SceneSpec(
        robot=scene.robot,
        family="remembered",
        seed=0,
        objects=things,
        places=scene.places,
        mover=mover,
        region=scene.region,
        chart=chart,
    )
    check_scene(spec)
    return spec


def _is_simulated(thing: SceneObject) -> bool:
    """Whether it is a body among others: no person, no table top or floor without an end, nothing that a map closes."""
    return thing.role != "person" and not isinstance(thing.shape, HalfSpace) and thing.category != KEEP_OUT_CATEGORY


def _keep_out_area(thing: SceneObject) -> KeepOutArea:
    """What a map closes, on the floor again."""
    assert isinstance(thing.shape, Box)
    (x, y, _), (a, b, _) = thing.pose.position, thing.shape.half_extents
    w, _, _, z = thing.pose.quaternion
    return KeepOutArea(thing.name, (x, y), (a, b), 2.0 * atan2(z, w))


def _object_spec(thing: SceneObject, shift: np.ndarray, *, room: bool) -> ObjectSpec:
    """In a `room` what is no object stands as if it were fixed: how heavy crates and tables are, nobody has seen."""
    fixed = (room and thing.role in ("obstacle", "support")) or (
        thing.role == "obstacle" and _bottom_height(thing) > TABLE_TOLERANCE
    )
    x, y, z = thing.pose.position
    if not fixed:
        x, y = x + float(shift[0]), y + float(shift[1])
        z = z - _bottom_height(thing) + INITIAL_CLEARANCE if abs(_bottom_height(thing)) < TABLE_TOLERANCE else z
    mass = float(np.clip(ASSUMED_DENSITY * _volume(thing.shape), MIN_MASS, MAX_MASS))
    return ObjectSpec(
        name=thing.name,
        role=thing.role,
        shape=thing.shape,
        position=(x, y, z),
        mass=mass,
        colour=thing.colour,
        category=thing.category,
        quaternion=thing.pose.quaternion,
        fragile_limit=thing.fragile_limit,
        fixed=fixed,
    )


def _moving_person(person: SceneObject) -> MovingPerson:
    """Somebody who goes on as perceived and comes back; one who stands still rests for good."""
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


def _bottom_height(thing: SceneObject) -> float:
    """Height of the lowest point of an upright thing [m]."""
    z = thing.pose.position[2]
    match thing.shape:
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
    """Solid volume [m³]."""
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
