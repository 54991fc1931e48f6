"""Closest points agree with the exact distances of the shapes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.core.geometry.distance import signed_distance
from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Sphere
from dualbrain.drivers.ros2.closest_points import closest_point, closest_points
from tests.drivers.ros2.node_under_test import HOME, make_core

SHAPES = (Sphere(0.2), Capsule(0.1, 0.3), Box((0.1, 0.2, 0.3)), HalfSpace())
COORDINATE = st.floats(-1.0, 1.0)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: type(shape).__name__)
@given(point=st.tuples(COORDINATE, COORDINATE, COORDINATE), turn=st.tuples(*[st.floats(0.1, 1.0)] * 4))
def test_the_closest_point_is_on_the_surface_at_the_signed_distance(shape, point, turn):
    quaternion = np.array(turn) / np.linalg.norm(turn)
    pose = Pose((0.3, -0.2, 0.1), tuple(quaternion.tolist()))
    found = closest_point(shape, pose, np.array(point))
    assert signed_distance(shape, pose, found) == pytest.approx(0.0, abs=1e-9)
    distance = abs(float(signed_distance(shape, pose, np.array(point))))
    assert np.linalg.norm(found - np.array(point)) == pytest.approx(distance, abs=1e-9)


def test_every_obstacle_has_its_closest_points():
    core = make_core()
    found = {one.obstacle: one for one in closest_points(core.safety, HOME)}
    assert set(found) == {"table", "crate"}
    for one in found.values():
        assert np.linalg.norm(one.on_obstacle - one.on_robot) == pytest.approx(one.distance, abs=1e-9)
