"""A world rebuilt from what a robot once perceived: to try again in simulation what was done then."""

from __future__ import annotations

from math import atan2

import numpy as np

from dualbrain.core.geometry.rotations import matrix
from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, HalfSpace, Shape, Sphere
from dualbrain.records import Scene, SceneObject
from dualbrain.simulation.scenes.scene_spec import KEEP_OUT, Chart, Closed, Mover, SceneSpec, Thing, check_scene

DENSITY = 400.0
"""Things weigh this much [kg/m³]: neither perception nor memory knows their mass."""
LIGHTEST, HEAVIEST = 0.02, 0.5
ON_TABLE = 0.02
"""What seems to stand this near to the table top stands on it [m]."""
LIFT = 0.0005
"""Things begin this far above what they stand on [m]."""
MOVING, PASSES = 0.02, 3.0
"""A person faster than this [m/s] crosses, going on for this long [s] before turning back."""


def remembered_scene(scene: Scene, rng: np.random.Generator, *, spread: float) -> SceneSpec:
    """The scene as a simulated world, every free thing shifted by a normal error of `spread` [m] along x and y.

    What it is not: masses, friction and what was not perceived are unknown, so that one try proves little; several with
    different shifts are evidence. Raises `InvalidSetup` for a scene that cannot be simulated.
    """
    shut = tuple(_closed(thing) for thing in scene.objects if thing.category == KEEP_OUT)
    seen = [thing for thing in scene.objects if _stands(thing)]
    things = tuple(_thing(thing, rng.normal(0.0, spread, 2), room=bool(scene.region)) for thing in seen)
    people = [thing for thing in scene.objects if thing.role == "person" and isinstance(thing.shape, Capsule)]
    mover = _mover(people[0]) if people else None
    chart = Chart(scene.region, shut) if shut else None
    spec = SceneSpec(scene.robot, "remembered", 0, things, scene.places, mover, scene.region, chart=chart)
    check_scene(spec)
    return spec


def _stands(thing: SceneObject) -> bool:
    """Whether it is a body among others: no person, no table top or floor without an end, nothing that a map closes."""
    return thing.role != "person" and not isinstance(thing.shape, HalfSpace) and thing.category != KEEP_OUT


def _closed(thing: SceneObject) -> Closed:
    """What a map closes, on the floor again."""
    assert isinstance(thing.shape, Box)
    (x, y, _), (a, b, _) = thing.pose.position, thing.shape.half_extents
    w, _, _, z = thing.pose.quaternion
    return Closed(thing.name, (x, y), (a, b), 2.0 * atan2(z, w))


def _thing(thing: SceneObject, shift: np.ndarray, *, room: bool) -> Thing:
    """In a `room` what is no object stands as if it were fixed: how heavy crates and tables are, nobody has seen."""
    fixed = (room and thing.role in ("obstacle", "support")) or (thing.role == "obstacle" and _bottom(thing) > ON_TABLE)
    x, y, z = thing.pose.position
    if not fixed:
        x, y = x + float(shift[0]), y + float(shift[1])
        z = z - _bottom(thing) + LIFT if abs(_bottom(thing)) < ON_TABLE else z
    mass = float(np.clip(DENSITY * _volume(thing.shape), LIGHTEST, HEAVIEST))
    return Thing(
        thing.name, thing.role, thing.shape, (x, y, z), mass, thing.colour, thing.category, thing.pose.quaternion,
        fragile_limit=thing.fragile_limit, fixed=fixed,
    )  # fmt: skip


def _mover(person: SceneObject) -> Mover:
    """Somebody who goes on as perceived and comes back; one who stands still rests for good."""
    start, velocity = np.asarray(person.pose.position), np.asarray(person.velocity)
    speed = float(np.linalg.norm(velocity))
    assert isinstance(person.shape, Capsule)
    end = start + velocity * PASSES if speed > MOVING else start + np.array([0.0, 0.001, 0.0])
    pause = 0.0 if speed > MOVING else 1e6
    a, b, axis = (_triple(v) for v in (start, end, matrix(person.pose.quaternion)[:, 2]))
    shape = person.shape
    return Mover(a, b, max(speed, 0.01), pause, 0.0, person.name, shape.radius, shape.half_length, axis)


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def _bottom(thing: SceneObject) -> float:
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
