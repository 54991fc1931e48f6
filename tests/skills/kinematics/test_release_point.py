"""The release point in a bowl: inside the wall, above the rim, and clear of the contents by one way or the other."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.core.geometry.shapes import Bowl, Box, Cylinder, Pose
from dualbrain.records import Place, Scene, SceneObject
from dualbrain.skills.kinematics.object_geometry import top_height
from dualbrain.skills.kinematics.release_point import (
    CONTENTS_CLEARANCE,
    DROP_HEIGHT,
    RIM_CLEARANCE,
    WALL_CLEARANCE,
    find_release_point,
    receiving_point,
)

BOWL = SceneObject(name="bowl", role="container", shape=Bowl(0.1, 0.06, 0.004), pose=Pose((0.5, 0.2, 0.0)))
LOAD = SceneObject(name="load", role="object", shape=Box((0.02, 0.02, 0.025)), pose=Pose((0.3, 0.0, 0.4)))
HALF_DIAGONAL = float(np.hypot(0.02, 0.02))
RIM = 0.06


def scene_with(*contents):
    objects = tuple(
        SceneObject(name=f"content_{index}", role="object", shape=shape, pose=Pose(position), error=0.003)
        for index, (shape, position) in enumerate(contents)
    )
    places = (Place("shelf_left", (0.4, -0.2, 0.3)),)
    return Scene(robot="panda", stamp=0.0, version=1, objects=(BOWL, LOAD, *objects), places=places)


def plan_distance(release, obj):
    return float(np.linalg.norm(release.position[:2] - np.array(obj.pose.position[:2])))


positions = st.tuples(st.floats(0.42, 0.58), st.floats(0.12, 0.28), st.floats(0.02, 0.09))
shapes = st.sampled_from([Box((0.02, 0.02, 0.02)), Cylinder(0.022, 0.022), Cylinder(0.03, 0.06)])


def test_an_empty_bowl_receives_at_its_centre():
    release = find_release_point(scene_with(), "bowl", "load")
    assert np.allclose(release.position, [0.5, 0.2, RIM + RIM_CLEARANCE])
    assert (release.radius, release.leaning) == (0.1, True)


def test_an_object_beside_the_bowl_changes_nothing():
    beside = scene_with((Box((0.02, 0.02, 0.02)), (0.5, 0.34, 0.02)))
    assert np.allclose(find_release_point(beside, "bowl", "load").position, [0.5, 0.2, RIM + RIM_CLEARANCE])


def test_a_place_receives_just_above_its_surface():
    release = find_release_point(scene_with(), "shelf_left", "load")
    assert np.allclose(release.position, [0.4, -0.2, 0.3 + DROP_HEIGHT])
    assert not release.leaning


@given(contents=st.lists(st.tuples(shapes, positions), max_size=4))
def test_the_load_fits_inside_the_wall_and_never_below_the_rim(contents):
    release = find_release_point(scene_with(*contents), "bowl", "load")
    offset = float(np.linalg.norm(release.position[:2] - release.centre))
    assert offset + HALF_DIAGONAL <= 0.1 - 0.004
    assert release.position[2] >= RIM + RIM_CLEARANCE - 1e-12
    assert np.allclose(release.centre, receiving_point(scene_with(), "bowl")[:2])


@given(contents=st.lists(st.tuples(shapes, positions), min_size=1, max_size=4))
def test_the_load_is_released_beside_or_above_every_object_in_the_bowl(contents):
    scene = scene_with(*contents)
    release = find_release_point(scene, "bowl", "load")
    for obj in scene.objects[2:]:
        inside = float(np.linalg.norm(np.subtract(obj.pose.position, BOWL.pose.position)[:2])) < 0.1
        width = HALF_DIAGONAL if isinstance(obj.shape, Box) else obj.shape.radius
        beside = plan_distance(release, obj) >= HALF_DIAGONAL + width + CONTENTS_CLEARANCE
        above = release.position[2] >= top_height(obj) + CONTENTS_CLEARANCE
        assert not inside or beside or above


@given(distance=st.floats(0.0, 0.039), angle=st.floats(-np.pi, np.pi), height=st.floats(0.02, 0.09), shape=shapes)
def test_a_load_that_overlaps_at_the_centre_is_released_on_the_far_side(distance, angle, height, shape):
    x, y = distance * np.cos(angle), distance * np.sin(angle)
    release = find_release_point(scene_with((shape, (0.5 + x, 0.2 + y, height))), "bowl", "load")
    offset = release.position[:2] - release.centre
    assert np.linalg.norm(offset) == pytest.approx(0.1 - 0.004 - HALF_DIAGONAL - WALL_CLEARANCE)
    assert offset @ np.array([x, y]) <= 1e-9


@pytest.mark.parametrize("height", [0.04, 0.09])
def test_a_load_that_fits_nowhere_beside_the_contents_is_released_above_them(height):
    wide = scene_with((Cylinder(0.06, 0.02), (0.5, 0.2, height)))
    release = find_release_point(wide, "bowl", "load")
    top = height + 0.02 + 0.003 + CONTENTS_CLEARANCE
    assert release.position[2] == pytest.approx(max(top, RIM + RIM_CLEARANCE))
