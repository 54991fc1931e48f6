"""Two scenes show the same place if every object in them is at the same position, with any name."""

from math import radians

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.core.geometry.rotations import matrix_to_quaternion, quaternion_to_matrix
from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, HalfSpace, Pose, Sphere
from dualbrain.records import SceneObject
from dualbrain.runtime.planning.reuse.same_place import (
    MAX_ANGLE,
    MAX_DISTANCE,
    is_same_object,
    match_places,
    same_posture,
)
from tests.grounding.perceived_scenes import bowl, box, forearm, scene, yaw_quaternion

LEFT = ("table_left", (0.5, 0.35, 0.0))
CUBE, BLOCK = box("red_cube", 0.5, -0.2), box("green_box", 0.45, 0.1, (0.03, 0.02, 0.025))
THEN = scene(CUBE, BLOCK, bowl(), places=[LEFT])
SAME = {name: name for name in ("table", "red_cube", "green_box", "blue_bowl", "table_left")}


def changed(obj, **fields):
    return msgspec.structs.replace(obj, **fields)


def moved(obj, x=0.0, y=0.0, z=0.0):
    return changed(obj, pose=Pose(tuple(np.add(obj.pose.position, (x, y, z)).tolist()), obj.pose.quaternion))


def test_a_place_is_the_same_in_any_order_of_its_objects_and_within_the_errors_of_perception():
    assert match_places(THEN, THEN) == SAME
    assert match_places(THEN, scene(bowl(), moved(BLOCK, 0.01, 0.01), CUBE, places=[LEFT])) == SAME


@pytest.mark.parametrize(
    "now",
    [
        scene(CUBE, bowl(), places=[LEFT]),
        scene(CUBE, BLOCK, bowl(), box("tin", 0.3, 0.3), places=[LEFT]),
        scene(moved(CUBE, x=0.021), BLOCK, bowl(), places=[LEFT]),
        scene(moved(CUBE, z=0.03), BLOCK, bowl(), places=[LEFT]),
        scene(CUBE, box("green_box", 0.45, 0.1, (0.03, 0.02, 0.025), yaw=radians(12)), bowl(), places=[LEFT]),
        scene(CUBE, box("green_box", 0.45, 0.1, (0.036, 0.02, 0.025)), bowl(), places=[LEFT]),
        scene(changed(CUBE, role="obstacle"), BLOCK, bowl(), places=[LEFT]),
        scene(CUBE, BLOCK, bowl(), forearm(0.7, 0.2), places=[LEFT]),
        changed(THEN, region=((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))),
    ],
)
def test_a_place_with_anything_added_removed_moved_turned_or_changed_is_another(now):
    assert match_places(THEN, now) is None
    assert match_places(now, THEN) is None


def test_people_are_compared_by_number_because_they_move():
    beside, across = (scene(CUBE, bowl(), forearm(x, 0.2, (v, 0.0, 0.0))) for x, v in ((0.6, 0.0), (0.9, 0.4)))
    assert match_places(beside, across) is not None
    assert match_places(beside, scene(CUBE, bowl())) is None


def test_an_object_with_a_new_name_gets_it_and_a_place_that_moved_has_none():
    now = scene(changed(CUBE, name="crimson_cube"), BLOCK, bowl(), places=[("table_left", (0.5, 0.30, 0.0))])
    names = {key: key for key in SAME if key != "table_left"}
    assert match_places(THEN, now) == names | {"red_cube": "crimson_cube"}


def test_two_equal_objects_that_exchanged_their_names_are_identified_by_position():
    one, other = box("one", 0.5, -0.2), box("other", 0.5, 0.1)
    now = scene(changed(one, name="other"), changed(other, name="one"))
    names = match_places(scene(one, other), now)
    assert (names["one"], names["other"]) == ("other", "one")


def test_two_objects_do_not_match_the_same_one():
    """Both are within 2 cm of an object between them, and another object is elsewhere."""
    then = scene(box("one", 0.5, 0.0), box("other", 0.5, 0.03))
    assert match_places(then, scene(box("one", 0.5, 0.015), box("other", 0.3, 0.3))) is None


ROUND = (Cylinder(0.03, 0.05), Capsule(0.03, 0.05), Bowl(0.08, 0.05, 0.004), Sphere(0.03), HalfSpace())
UPSIDE_DOWN = (0.0, 1.0, 0.0, 0.0)
TILTED = (float(np.cos(0.2)), float(np.sin(0.2)), 0.0, 0.0)
QUARTER = yaw_quaternion(np.pi / 2.0)


def thing(shape, quaternion=(1.0, 0.0, 0.0, 0.0), role="obstacle"):
    return SceneObject(name="thing", role=role, shape=shape, pose=Pose((0.5, 0.0, 0.1), quaternion))


@pytest.mark.parametrize("shape", ROUND)
def test_a_round_obstacle_is_compared_by_its_axis(shape):
    upright = thing(shape)
    assert is_same_object(upright, thing(shape, yaw_quaternion(1.0)))
    assert is_same_object(upright, thing(shape, TILTED)) == isinstance(shape, Sphere)
    assert is_same_object(upright, thing(shape, UPSIDE_DOWN)) == isinstance(shape, Cylinder | Capsule | Sphere)
    assert not any(is_same_object(upright, thing(other)) for other in ROUND if other is not shape)


@pytest.mark.parametrize("shape", [Box((0.02, 0.02, 0.025)), Cylinder(0.03, 0.05)])
def test_a_graspable_object_that_was_turned_is_another_because_its_finger_axes_were(shape):
    """Also by a symmetry: a grasp "along" a cube that was turned by 90 degrees closes in another direction."""
    upright = thing(shape, role="object")
    assert not is_same_object(upright, thing(shape, QUARTER, "object"))
    assert is_same_object(upright, thing(shape, yaw_quaternion(np.pi), "object"))
    assert is_same_object(upright, thing(shape, yaw_quaternion(MAX_ANGLE - 0.01), "object"))


@pytest.mark.parametrize(
    ("shape", "other"),
    [
        (Box((0.02, 0.02, 0.025)), Box((0.02, 0.026, 0.025))),
        (Cylinder(0.03, 0.05), Cylinder(0.036, 0.05)),
        (Cylinder(0.03, 0.05), Cylinder(0.03, 0.056)),
        (Capsule(0.03, 0.05), Capsule(0.03, 0.056)),
        (Bowl(0.08, 0.05, 0.004), Bowl(0.08, 0.056, 0.004)),
        (Sphere(0.03), Sphere(0.036)),
    ],
)
def test_a_shape_of_another_size_is_another_object(shape, other):
    assert not is_same_object(thing(shape), thing(other))


@pytest.mark.parametrize("quaternion", [(0.0, 0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0), (np.nan, 0.0, 0.0, 0.0)])
def test_a_malformed_orientation_is_no_place(quaternion):
    malformed = thing(Box((0.02, 0.02, 0.025)), quaternion)
    assert not is_same_object(malformed, malformed)


unit = st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)


@given(quaternion=unit, axis=st.sampled_from((0, 1, 2)), excess=st.sampled_from((-0.01, 0.01)))
@settings(max_examples=200, deadline=None)
def test_a_box_is_the_same_up_to_half_turns_and_ten_degrees(quaternion, axis, excess):
    rotation, shape = quaternion_to_matrix(quaternion), Box((0.02, 0.03, 0.05))
    original = thing(shape, matrix_to_quaternion(rotation))
    half_turn = quaternion_to_matrix((0.0, *np.eye(3)[axis]))
    assert is_same_object(original, thing(shape, matrix_to_quaternion(rotation @ half_turn)))
    half = (MAX_ANGLE + excess) / 2.0
    turned = rotation @ quaternion_to_matrix((np.cos(half), *(np.sin(half) * np.eye(3)[axis])))
    assert is_same_object(original, thing(shape, matrix_to_quaternion(turned))) == (excess < 0.0)


@given(shift=st.tuples(*[st.floats(-0.04, 0.04)] * 3))
@settings(deadline=None)
def test_the_relation_is_symmetric_and_ends_at_the_distance(shift):
    one, other = thing(Sphere(0.03)), moved(thing(Sphere(0.03)), *shift)
    assert is_same_object(one, other) == is_same_object(other, one)
    distance = float(np.linalg.norm(shift))
    if abs(distance - MAX_DISTANCE) > 1e-9:
        assert is_same_object(one, other) == (distance <= MAX_DISTANCE)


def test_postures_are_the_same_if_every_joint_is_near():
    home = (0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.8)
    assert same_posture(home, tuple(q + 0.04 for q in home))
    assert not same_posture(home, (*home[:6], 0.86))
    assert not same_posture(home, home[:6])
