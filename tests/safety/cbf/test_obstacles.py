"""Conversion of scene objects to obstacles: covers contain the objects, margins include the errors."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.core.geometry.distance import bounding_solid
from dualbrain.core.geometry.shapes import Bowl, Box, Cylinder, HalfSpace, Pose, Sphere
from dualbrain.records import Scene, SceneObject
from dualbrain.safety.cbf.grasped_object import cover_with_spheres
from dualbrain.safety.cbf.obstacles import obstacles_from_scene
from tests.safety import geometry_oracle, random_scenes

SIZE = st.floats(0.005, 0.2)


def surface(shape, rng, count=2000):
    """Random points on or in a cylinder, bowl or box, in its own frame."""
    match shape:
        case Cylinder(radius=r, half_height=h):
            turn, reach = rng.uniform(0, 2 * np.pi, count), r * np.sqrt(rng.uniform(0, 1, count))
            reach[: count // 2] = r
            z = rng.uniform(-h, h, count)
            z[: count // 4] = h * rng.choice([-1.0, 1.0], count // 4)
            return np.column_stack([reach * np.cos(turn), reach * np.sin(turn), z])
        case Bowl(radius=r, height=h):
            turn = rng.uniform(0, 2 * np.pi, count)
            return np.column_stack([r * np.cos(turn), r * np.sin(turn), rng.uniform(0, h, count)])
        case Box(half_extents=e):
            return rng.uniform(-1, 1, (count, 3)) * np.array(e)


@given(SIZE, SIZE, st.integers(0, 100))
def test_covers_contain_cylinders_and_bowls(radius, height, seed):
    rng = np.random.default_rng(seed)
    pose = Pose(tuple(rng.uniform(-1, 1, 3)), random_scenes.random_quaternion(rng))
    for shape in (Cylinder(radius, height), Bowl(radius, height, 0.002)):
        world = surface(shape, rng) @ geometry_oracle.rotation_matrix(pose.quaternion).T + np.array(pose.position)
        outer, where = bounding_solid(shape, pose)
        assert geometry_oracle.surface_distance(outer, where, world).max() <= 1e-9


@given(SIZE, SIZE, SIZE, st.integers(0, 100))
def test_held_objects_are_covered_by_at_most_eight_spheres(x, y, z, seed):
    rng = np.random.default_rng(seed)
    tool_p, tool_R = rng.uniform(-1, 1, 3), geometry_oracle.rotation_matrix(random_scenes.random_quaternion(rng))
    pose = Pose(tuple(tool_p + rng.uniform(-0.05, 0.05, 3)), random_scenes.random_quaternion(rng))
    for shape in (Box((x, y, z)), Cylinder(x, y), Bowl(x, y, 0.002)):
        spheres = cover_with_spheres(SceneObject(name="object", role="object", shape=shape, pose=pose), tool_p, tool_R)
        assert 1 <= len(spheres) <= 8
        world = surface(shape, rng) @ geometry_oracle.rotation_matrix(pose.quaternion).T + np.array(pose.position)
        local = (world - tool_p) @ tool_R
        gaps = np.linalg.norm(local[:, None] - spheres[None, :, :3], axis=2) - spheres[None, :, 3]
        assert gaps.min(axis=1).max() <= 1e-9


def test_a_held_cube_is_covered_tightly():
    cube = SceneObject(name="cube", role="object", shape=Box((0.02, 0.02, 0.02)), pose=Pose((0.0, 0.0, 0.1)))
    spheres = cover_with_spheres(cube, np.zeros(3), np.eye(3))
    assert len(spheres) == 8
    assert np.max(np.abs(spheres[:, :3] - [0, 0, 0.1]) + spheres[:, 3:]) < 0.02 + 0.008


def test_a_scene_becomes_obstacles_with_its_errors():
    scene = Scene(
        robot="panda",
        stamp=2.0,
        version=1,
        objects=(
            SceneObject(name="table", role="support", shape=HalfSpace(), pose=Pose((0.0, 0.0, 0.0)), error=0.001),
            SceneObject(
                name="cup",
                role="object",
                shape=Cylinder(0.03, 0.05),
                pose=Pose((0.5, 0.0, 0.05)),
                error=0.009,
                stamp=2.0,
            ),
            SceneObject(
                name="arm",
                role="person",
                shape=Sphere(0.05),
                pose=Pose((0.5, 0.5, 0.4)),
                velocity=(0.1, 0.0, 0.0),
                error=0.009,
                velocity_error=0.05,
                stamp=1.8,
            ),
            SceneObject(name="gone", role="object", shape=Sphere(0.02), pose=Pose((0.4, 0.0, 0.02))),
        ),
    )
    table, cup, person = obstacles_from_scene(scene, known={"table"}, held="gone", clearance=0.002)
    assert (table.known, cup.known, table.static, person.static) == (True, False, True, False)
    assert cup.margin == pytest.approx(0.011)
    assert person.margin == pytest.approx(0.009 + 0.05 * 0.2 + 0.002)
    assert person.pose.position == pytest.approx((0.52, 0.5, 0.4))
    assert person.velocity_error == 0.05
