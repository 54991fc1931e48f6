"""Relations of perceived objects: limits, signs, and the band of the perception error in which nothing is decided."""

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Box, Cylinder, Pose
from dualbrain.grounding.outcome.spatial_relations import (
    below,
    is_at,
    is_container_empty,
    is_inside,
    relation_holds,
    support_height,
)
from tests.grounding.outcome.tabletop_cases import BEFORE

BOWL = BEFORE.find("blue_bowl")
PLACE = BEFORE.places[0]


def cube_at(x, y, z=0.025):
    """The red cube with its centre at (x, y, z) [m]."""
    cube = BEFORE.find("red_cube")
    return msgspec.structs.replace(cube, pose=Pose((x, y, z), cube.pose.quaternion))


def support_at(x, y, height, *, half_width=0.3):
    """A table with its centre at (x, y) and its top at `height` [m], turned by 45 degrees about the vertical."""
    shape, turned = Box((half_width, 0.2, 0.5 * height)), (np.cos(np.pi / 8), 0.0, 0.0, np.sin(np.pi / 8))
    cube = BEFORE.find("red_cube")
    return msgspec.structs.replace(
        cube, name=f"table at {x}", role="support", shape=shape, pose=Pose((x, y, 0.5 * height), turned)
    )


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize(
    ("x", "y", "expected"),
    [
        (0.0, 0.0, 0.5),
        (2.0, 0.0, 0.3),
        (0.2, 0.2, 0.5),  # on the turned table, at the end of its long side
        (1.3, 0.0, 0.3),  # beside both, nearer to the second
        (-1.0, 0.0, 0.5),
    ],
)
def test_the_support_is_the_one_below_or_else_the_nearest(x, y, expected, reverse):
    tables = (support_at(0.0, 0.0, 0.5), support_at(2.0, 0.0, 0.3))
    cube = cube_at(x, y)
    scene = msgspec.structs.replace(BEFORE, objects=(*(reversed(tables) if reverse else tables), cube))
    assert support_height(scene, cube) == pytest.approx(expected)


def test_of_two_supports_below_an_object_the_upper_one_counts():
    scene = msgspec.structs.replace(BEFORE, objects=(support_at(0.0, 0.0, 0.5), support_at(0.0, 0.05, 0.7)))
    assert support_height(scene, cube_at(0.0, 0.0, 1.0)) == pytest.approx(0.7)
    assert support_height(msgspec.structs.replace(BEFORE, objects=()), cube_at(0.0, 0.0)) == 0.0


def relation(cube, name, *references):
    others = tuple(obj for obj in BEFORE.objects if obj.name != "red_cube")
    scene = msgspec.structs.replace(BEFORE, objects=(*others, cube))
    return relation_holds(cube, name, references or ("blue_bowl",), scene)


@pytest.mark.parametrize(
    ("value", "expected"), [(0.08, True), (0.0899, True), (0.091, None), (0.109, None), (0.11, False), (0.2, False)]
)
def test_a_length_within_the_error_of_the_limit_is_not_decided(value, expected):
    assert below(value, 0.1, 0.01) is expected


@pytest.mark.parametrize(
    ("height", "expected"), [(-0.05, False), (0.0, None), (0.03, True), (0.06, None), (0.2, False)]
)
def test_inside_is_above_the_bottom_and_below_the_rim(height, expected):
    assert is_inside(cube_at(0.50, 0.25, height), BOWL) is expected


@pytest.mark.parametrize(("height", "expected"), [(0.08, True), (0.10, None), (0.13, False)])
def test_an_object_taller_than_the_bowl_is_inside_if_its_lowest_point_is_low(height, expected):
    bottle = msgspec.structs.replace(cube_at(0.50, 0.25, height), shape=Cylinder(0.02, 0.075))
    assert is_inside(bottle, BOWL) is expected


@pytest.mark.parametrize(
    ("dy", "height", "expected"),
    [(0.0, 0.025, True), (0.045, 0.025, None), (0.07, 0.025, False), (0.0, 0.2, False), (0.0, -0.05, False)],
)
def test_at_a_place_is_near_it_and_on_its_surface(dy, height, expected):
    x, y, _ = PLACE.position
    assert is_at(cube_at(x, y + dy, height), PLACE) is expected


@pytest.mark.parametrize(
    ("x", "y", "left", "right"),
    [
        (0.50, 0.40, True, False),
        (0.50, 0.10, False, True),
        (0.70, 0.30, False, False),  # ahead of the bowl rather than beside it
        (0.62, 0.37, None, False),  # on the diagonal
    ],
)
def test_left_and_right_are_those_of_the_robot(x, y, left, right):
    assert relation(cube_at(x, y), "left_of") is left
    assert relation(cube_at(x, y), "right_of") is right


@pytest.mark.parametrize("name", ["near", "at", "left_of"])
def test_an_object_on_the_floor_is_not_beside_one_on_the_table(name):
    assert relation(cube_at(0.50, 0.37), name) is True
    assert relation(cube_at(0.50, 0.37, -0.695), name) is False


@pytest.mark.parametrize("name", ["in_front_of", "behind"])
def test_before_and_behind_depend_on_the_point_of_view(name):
    assert relation(cube_at(0.70, 0.25), name) is None
    assert relation(cube_at(0.50, 0.45), name) is False  # beside it from every point of view along the x-axis
    assert relation(cube_at(0.50, 0.25, 0.03), name) is False  # inside it


@pytest.mark.parametrize(("height", "expected"), [(0.065, True), (0.045, None), (0.025, False), (0.25, False)])
def test_on_an_object_is_above_its_middle_and_not_in_the_air(height, expected):
    assert relation(cube_at(0.60, -0.12, height), "on", "yellow_block") is expected


@pytest.mark.parametrize(
    ("x", "y", "height", "expected"),
    [
        (0.50, 0.00, 0.025, True),
        (0.50, 0.35, 0.025, False),  # beyond the bowl
        (0.50, -0.45, 0.025, False),  # beyond the other end
        (0.65, 0.00, 0.025, False),  # beside the line
        (0.50, 0.00, 0.200, False),  # above the line
    ],
)
def test_between_is_on_the_table_and_near_the_line(x, y, height, expected):
    objects = [
        msgspec.structs.replace(obj, pose=Pose((0.50, -0.25, 0.022))) if obj.name == "green_tin" else obj
        for obj in BEFORE.objects
        if obj.name != "red_cube"
    ]
    cube = cube_at(x, y, height)
    scene = msgspec.structs.replace(BEFORE, objects=(*objects, cube))
    assert relation_holds(cube, "between", ("blue_bowl", "green_tin"), scene) is expected


def test_between_on_a_slanted_line():
    """The distance from the line has a sign of its own: a point on the other diagonal is beside the line."""
    ends = ("table_left", "table_front")
    (ax, ay, _), (bx, by, _) = (place.position for place in BEFORE.places if place.name in ends)
    assert relation(cube_at((ax + bx) / 2, (ay + by) / 2), "between", *ends) is True
    assert relation(cube_at((ax + bx) / 2 + 0.12, (ay + by) / 2 + 0.12), "between", *ends) is False


def test_a_relation_to_an_object_that_is_not_perceived_is_not_decided():
    assert relation(cube_at(0.5, 0.25, 0.03), "in", "green_bowl") is None


def test_a_container_is_empty_if_no_object_is_inside():
    assert is_container_empty(BEFORE, "bowl") is True
    others = tuple(obj for obj in BEFORE.objects if obj.name != "red_cube")
    for height, expected in ((0.03, False), (0.06, None)):
        full = msgspec.structs.replace(BEFORE, objects=(*others, cube_at(0.50, 0.25, height)))
        assert is_container_empty(full, "blue_bowl") is expected
    assert is_container_empty(BEFORE, "red_cube") is None
