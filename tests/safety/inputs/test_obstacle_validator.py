"""The fast validators refuse exactly the obstacles and scenes that the full ones refuse, with the same error.

The oracle of an obstacle is its full validator, `check_obstacle`, with the earlier test for the usual case before it;
that of a scene is the full validator of each of its objects, `check_scene_object`.
"""

from math import sqrt

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry import validation
from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, HalfSpace, Pose, Sphere
from dualbrain.errors import GeometryError
from dualbrain.records import Place, Scene, SceneObject
from dualbrain.safety.cbf.filter import SpeedAndSeparation
from dualbrain.safety.cbf.kernel import MAX_OBSTACLES, OBSTACLE_COLUMNS, obstacle_table
from dualbrain.safety.cbf.obstacles import (
    MAX_CLOCK_LEAD,
    Obstacle,
    check_obstacle,
    check_obstacles,
    check_scene,
    check_scene_object,
)
from dualbrain.safety.cbf.rows import Rank
from experiments.interfaces.bad_values import KINDS, LENGTH, NUMBER, QUATERNION, SIZES, VECTOR, make_value
from tests.safety.random_scenes import random_quaternion

NEAR_LIMITS = (
    *(0.0, -0.0, 1000.0, np.nextafter(1000.0, 2e3), validation.SMALLEST_LENGTH, validation.SMALLEST_LENGTH * 0.99),
    *(
        5e-324,
        -1e-300,
        -1000.0,
        np.nextafter(-1000.0, -2e3),
        float("nan"),
        float("inf"),
        1,
        0,
        10**400,
        np.float64(0.5),
    ),
)
"""Numbers at the limits of the validator, and numbers of other types."""
SIZES_IN = {Sphere: 1, Capsule: 2, Cylinder: 2, Bowl: 3}


def equal_by_earlier_test(obstacle):
    """The test for the usual case before it was made faster: the types, then the bounds, of all numbers together."""
    if type(obstacle) is not Obstacle or type(obstacle.pose) is not Pose:
        return False
    sizes = {
        Sphere: lambda shape: (shape.radius,),
        Capsule: lambda shape: (shape.radius, shape.half_length),
        HalfSpace: lambda shape: (),
        Box: lambda shape: (
            shape.half_extents if isinstance(shape.half_extents, tuple) and len(shape.half_extents) == 3 else ("",)
        ),
    }.get(type(obstacle.shape))
    place, turn, velocity = obstacle.pose.position, obstacle.pose.quaternion, obstacle.velocity
    if sizes is None or {type(place), type(turn), type(velocity)} != {tuple}:
        return False
    if (len(place), len(turn), len(velocity)) != (3, 4, 3):
        return False
    lengths = (obstacle.margin, obstacle.velocity_error, *sizes(obstacle.shape))
    return (
        {*map(type, (*place, *turn, *velocity, *lengths))} <= {float, int}
        and all(-1000.0 <= value <= 1000.0 for value in (*place, *velocity))
        and all(-2.0 <= value <= 2.0 for value in turn)
        and abs(sum(value * value for value in turn) - 1.0) < 1e-9
        and all(length == 0.0 or validation.SMALLEST_LENGTH <= length <= 1000.0 for length in lengths)
        and type(obstacle.name) is type(obstacle.barrier) is str
        and max(len(obstacle.name), len(obstacle.barrier)) <= 1000
        and type(obstacle.rank) is Rank
        and type(obstacle.known) is type(obstacle.static) is bool
        and not (obstacle.static and obstacle.moves)
        and obstacle.parts == ()
        and obstacle.alpha is obstacle.separation is None
    )


def outcome(check, obstacle):
    """The table of the kernel and the other fields of the checked obstacle, or the text of its refusal."""
    try:
        found = check(obstacle)
    except GeometryError as error:
        return str(error)
    others = (found.name, found.barrier, found.known, found.static, found.rank, found.parts, found.alpha)
    return others, type(found.shape), obstacle_table([found], {"hand": (0,)}).tolist()


def by_oracle(obstacle):
    return obstacle if equal_by_earlier_test(obstacle) else check_obstacle(obstacle, 0)


def random_shape(rng):
    kinds = [Sphere, Capsule, Box, HalfSpace, Cylinder, Bowl]
    kind = kinds[int(rng.choice(6, p=[0.3, 0.25, 0.25, 0.1, 0.05, 0.05]))]
    if kind is Box:
        return Box(value(rng, SIZES, tuple(rng.uniform(0.01, 0.3, 3))))
    return kind(*(value(rng, LENGTH, float(rng.uniform(0.01, 0.3))) for _ in range(SIZES_IN.get(kind, 0))))


def value(rng, form, valid):
    """Mostly the valid value; else one of the bad kinds, or numbers near the limits."""
    if rng.random() < 0.9:
        return valid
    if rng.random() < 0.5:
        return make_value(KINDS[int(rng.integers(len(KINDS)))], form, valid, rng)
    number = NEAR_LIMITS[int(rng.integers(len(NEAR_LIMITS)))]
    if np.ndim(valid) == 0:
        return number
    numbers = list(valid)
    numbers[int(rng.integers(len(numbers)))] = number
    return tuple(numbers)


def random_obstacle(rng):
    turn = tuple(float(one) for one in random_quaternion(rng))
    scale = float(rng.choice([1.0, 1.0, 1.0 + 1e-10, sqrt(1.0 + 0.99e-9), sqrt(1.0 + 1.01e-9), 1.05, 1.2]))
    still, plain = rng.random() < 0.7, rng.random() < 0.8

    def other(usual, *others):
        return usual if plain or rng.random() < 0.6 else others[int(rng.integers(len(others)))]

    return Obstacle(
        name=other("thing", "", "x" * 1000, "x" * 1001, 7, None),
        shape=other(random_shape(rng), None, "sphere", 0.1),
        pose=other(
            Pose(
                value(rng, VECTOR, tuple(float(one) for one in rng.uniform(-1.0, 1.0, 3))),
                value(rng, QUATERNION, tuple(one * scale for one in turn)),
            ),
            None,
            (0.0, 0.0, 0.0),
        ),
        velocity=value(rng, VECTOR, (0.0, 0.0, 0.0) if still else tuple(float(one) for one in rng.normal(size=3))),
        margin=value(rng, LENGTH, 0.01),
        velocity_error=value(rng, NUMBER, 0.0 if still else 0.05),
        known=other(False, True, 1, np.True_, None),
        static=other(still, True, False, 0, np.False_),
        rank=other(Rank.OBSTACLE, Rank.BODY, 2, None),
        alpha=other(None, 2.0, -1.0, float("nan"), "2"),
        parts=other((), ("hand",), ["hand"], [], "hand", (1,)),
        separation=other(None, SpeedAndSeparation(), 1.0),
        barrier=other("obstacle", "wall", "x" * 1001, b"wall"),
    )


@pytest.mark.parametrize("seed", range(8))
def test_the_fast_validator_agrees_with_the_oracle(seed):
    rng, refused = np.random.default_rng(seed), 0
    for _ in range(1500):
        obstacle = random_obstacle(rng)
        found = outcome(lambda one: check_obstacles((one,), 1)[0], obstacle)
        assert found == outcome(by_oracle, obstacle)
        assert found == outcome(lambda one: check_obstacles(iter((one,)), 1)[0], obstacle)
        refused += isinstance(found, str)
    assert 300 < refused < 1200


@pytest.mark.parametrize("number", NEAR_LIMITS)
@pytest.mark.parametrize(
    "place", ["x", "y", "z", "w", "qx", "qz", "vx", "vy", "vz", "margin", "velocity_error", "r", "hx", "hz", "half"]
)
@pytest.mark.parametrize("static", [True, False])
def test_every_number_is_compared_with_its_limits(place, number, static):
    def triple(names):
        return tuple(number if place == name else 0.0 for name in names.split())

    turn = tuple(number if place == name else one for name, one in (("w", 1.0), ("qx", 0.0), ("qy", 0.0), ("qz", 0.0)))
    shapes = {
        "hx": Box((number, 0.1, 0.1)),
        "hz": Box((0.1, 0.1, number)),
        "half": Capsule(0.1, number),
    }
    obstacle = Obstacle(
        "thing",
        shapes.get(place, Sphere(number if place == "r" else 0.1)),
        Pose(triple("x y z"), turn),
        velocity=triple("vx vy vz"),
        margin=number if place == "margin" else 0.0,
        velocity_error=number if place == "velocity_error" else 0.0,
        static=static,
    )
    assert outcome(lambda one: check_obstacles([one], 1)[0], obstacle) == outcome(by_oracle, obstacle)


def random_scene_object(rng):
    obstacle = random_obstacle(rng)
    return SceneObject(
        name=obstacle.name,
        role="object",
        shape=obstacle.shape,
        pose=obstacle.pose,
        velocity=obstacle.velocity,
        error=obstacle.margin,
        velocity_error=obstacle.velocity_error,
        stamp=value(rng, NUMBER, float(rng.choice([-1e6, 0.9, 1.0, 1.0 + MAX_CLOCK_LEAD, 1.006, 1e3]))),
    )


def checked_scene(obj):
    """The object of the checked scene, or the text of its refusal."""
    try:
        (found,) = check_scene(Scene(robot="panda", stamp=1.0, version=1, objects=(obj,))).objects
    except GeometryError as error:
        return str(error)
    return found


def checked_object(obj):
    """As `checked_scene`, by the full validator of one object and the rule of the stamps."""
    try:
        found = check_scene_object(obj)
    except GeometryError as error:
        return str(error)
    return found if found.stamp <= 1.0 + MAX_CLOCK_LEAD else "newer than the scene"


@pytest.mark.parametrize("seed", range(8))
def test_the_check_of_a_scene_agrees_with_that_of_its_objects(seed):
    rng, refused = np.random.default_rng(seed), 0
    for _ in range(1500):
        obj = random_scene_object(rng)
        found, expected = checked_scene(obj), checked_object(obj)
        if expected == "newer than the scene":
            assert "after the stamp of the scene" in found
        else:
            assert found == expected
        refused += isinstance(found, str)
    assert 300 < refused < 1400


def test_every_object_and_place_of_a_scene_has_a_name_of_its_own():
    cups = [SceneObject(name=name, role="object", shape=Sphere(0.03), pose=Pose((0.5, 0.1, 0.03))) for name in "aba"]
    one = Scene(robot="panda", stamp=0.0, version=1, objects=tuple(cups[:2]), places=(Place("c", (0.3, 0.2, 0.0)),))
    assert check_scene(one) is one
    for changes in (
        {"objects": tuple(cups)},
        {"places": (*one.places, *one.places)},
        {"places": (Place("b", (0.3, 0.2, 0.0)),)},
    ):
        with pytest.raises(GeometryError, match="one object or place for each name"):
            check_scene(msgspec.structs.replace(one, **changes))
    for place in (Place(("a",), (0.3, 0.2, 0.0)), "a", Place("a" * 10_000, (0.3, 0.2, 0.0))):
        with pytest.raises(GeometryError):
            check_scene(msgspec.structs.replace(one, places=(place,)))


@pytest.mark.parametrize("count", [0, 1, MAX_OBSTACLES, MAX_OBSTACLES + 1])
@pytest.mark.parametrize("make", [tuple, list, iter, lambda found: (one for one in found)])
def test_the_number_of_obstacles_is_limited_for_every_sequence(make, count):
    obstacles = [Obstacle(f"o{k}", Sphere(0.1)) for k in range(count)]
    if count > MAX_OBSTACLES:
        with pytest.raises(GeometryError, match=f"at most {MAX_OBSTACLES}"):
            check_obstacles(make(obstacles), MAX_OBSTACLES)
    else:
        assert check_obstacles(make(obstacles), MAX_OBSTACLES) == tuple(obstacles)


def test_the_table_has_the_same_bits_as_one_of_rotation_matrices():
    rng = np.random.default_rng(0)
    obstacles = [msgspec.structs.replace(random_valid(rng), name=f"o{k}") for k in range(MAX_OBSTACLES)]
    table = obstacle_table(obstacles)
    assert table.shape == (MAX_OBSTACLES, OBSTACLE_COLUMNS)
    for row, obstacle in zip(table, obstacles, strict=True):
        w, x, y, z = obstacle.pose.quaternion
        s = 2.0 / (w * w + x * x + y * y + z * z)
        rotation = [
            [1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
            [s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)],
            [s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)],
        ]
        assert row[5:17].tobytes() == np.array([*obstacle.pose.position, *np.ravel(rotation)]).tobytes()
        assert np.array_equal(quaternion_to_matrix(obstacle.pose.quaternion), rotation)


def random_valid(rng):
    while True:
        obstacle = random_obstacle(rng)
        if not isinstance(outcome(by_oracle, obstacle), str) and obstacle.parts == ():
            return by_oracle(obstacle)
