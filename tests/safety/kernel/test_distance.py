"""Distances and normals of every shape: against MuJoCo, finite differences and the numpy oracle."""

import mujoco
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Sphere
from dualbrain.safety.cbf.compiled import _kernel64
from dualbrain.safety.cbf.filter import Obstacle
from dualbrain.safety.cbf.kernel import obstacle_table
from tests.safety import geometry_oracle, random_scenes

SHAPES = [Sphere(0.07), Capsule(0.04, 0.15), Box((0.05, 0.1, 0.2)), HalfSpace()]


def measure(shape, pose, points):
    d, normals = np.empty(len(points)), np.empty((len(points), 3))
    _kernel64.distance(obstacle_table([Obstacle("x", shape, pose)])[0], np.ascontiguousarray(points), d, normals)
    return d, normals


@pytest.fixture(params=SHAPES, ids=lambda shape: type(shape).__name__)
def shape(request):
    return request.param


def random_pose(rng):
    return Pose(tuple(rng.uniform(-0.3, 0.3, 3)), random_scenes.random_quaternion(rng))


def test_distances_agree_with_the_oracle_inside_and_outside(shape, rng):
    for _ in range(20):
        pose, points = random_pose(rng), rng.uniform(-0.6, 0.6, (200, 3))
        d, _ = measure(shape, pose, points)
        np.testing.assert_allclose(d, geometry_oracle.surface_distance(shape, pose, points), atol=1e-6)


def test_normal_is_the_gradient(shape, rng):
    step = 1e-6
    for _ in range(10):
        pose, points = random_pose(rng), rng.uniform(-0.6, 0.6, (100, 3))
        d, normals = measure(shape, pose, points)
        for axis in range(3):
            shift = np.zeros(3)
            shift[axis] = step
            ahead, behind = measure(shape, pose, points + shift)[0], measure(shape, pose, points - shift)[0]
            slope = (ahead - behind) / (2 * step)
            smooth = np.abs((ahead - d) - (d - behind)) < 1e-9  # not across an inner edge of the box
            assert smooth.mean() > 0.98
            np.testing.assert_allclose(slope[smooth], normals[smooth, axis], atol=1e-3)


def test_following_the_normal_leaves_the_shape(shape, rng):
    pose = random_pose(rng)
    points = np.array(pose.position) + rng.uniform(-0.03, 0.03, (50, 3))
    d, normals = measure(shape, pose, points)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)
    out, _ = measure(shape, pose, points + normals * (0.01 - d)[:, None])
    assert np.all(out > -1e-9)


def test_distances_agree_with_mujoco(rng):
    geoms = {Sphere: "sphere", Capsule: "capsule", Box: "box"}
    for shape in SHAPES[:3]:
        pose = random_pose(rng)
        size = [shape.radius] if not isinstance(shape, Box) else shape.half_extents
        if isinstance(shape, Capsule):
            size = [shape.radius, shape.half_length]
        text = " ".join(f"{x:.9g}" for x in size)
        place, turn = " ".join(map(str, pose.position)), " ".join(map(str, pose.quaternion))
        model = mujoco.MjModel.from_xml_string(
            f"<mujoco><worldbody><geom name='o' type='{geoms[type(shape)]}' size='{text}' pos='{place}' quat='{turn}'/>"
            "<body name='b' mocap='true'><geom name='s' type='sphere' size='0.01'/></body></worldbody></mujoco>"
        )
        data = mujoco.MjData(model)
        for point in rng.uniform(-0.6, 0.6, (50, 3)):
            d = measure(shape, pose, point[None])[0][0] - 0.01
            if d < 1e-3:
                continue
            data.mocap_pos[0] = point
            mujoco.mj_forward(model, data)
            other = mujoco.mj_geomDistance(model, data, model.geom("o").id, model.geom("s").id, 5.0, None)
            assert d == pytest.approx(other, abs=2e-6)
