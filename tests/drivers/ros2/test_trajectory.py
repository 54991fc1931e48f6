"""Sampling of a trajectory: it goes through its points, and the velocity is the derivative of the position."""

import numpy as np
import pytest

from dualbrain.drivers.ros2.joint_order import JointOrder
from dualbrain.drivers.ros2.trajectory import TrajectoryMessage, TrajectoryPoint, read_trajectory
from tests.drivers.ros2.node_under_test import HOME, NAMES, PANDA, parameters

ORDER = JointOrder(PANDA, parameters())
TIMES = (0.5, 1.0, 2.5)


def make_trajectory(with_velocities, start=0.0):
    rng = np.random.default_rng(1)
    points = [
        TrajectoryPoint(
            (HOME + rng.uniform(-0.3, 0.3, 7)).tolist(),
            rng.uniform(-0.3, 0.3, 7).tolist() if with_velocities else [],
            t,
        )
        for t in TIMES
    ]
    return read_trajectory(TrajectoryMessage(NAMES, points, start), ORDER, HOME, 10.0), points


@pytest.mark.parametrize("with_velocities", [True, False])
def test_it_goes_through_its_points_from_the_present_position(with_velocities):
    trajectory, points = make_trajectory(with_velocities)
    assert trajectory.sample(10.0)[0] == pytest.approx(HOME)
    for point in points:
        position, velocity = trajectory.sample(10.0 + point.time)
        assert position == pytest.approx(point.positions)
        if with_velocities and point is not points[-1]:
            assert velocity == pytest.approx(point.velocities)


@pytest.mark.parametrize("with_velocities", [True, False])
def test_the_velocity_is_the_derivative_of_the_position(with_velocities):
    trajectory, _ = make_trajectory(with_velocities)
    step = 1e-6
    for time in (10.1, 10.7, 11.3, 12.4):
        change = trajectory.sample(time + step)[0] - trajectory.sample(time - step)[0]
        assert trajectory.sample(time)[1] == pytest.approx(change / (2.0 * step), abs=1e-6)


def test_it_rests_after_its_last_point_and_before_a_later_start():
    trajectory, points = make_trajectory(with_velocities=True)
    position, velocity = trajectory.sample(99.0)
    assert position == pytest.approx(points[-1].positions)
    assert np.all(velocity == 0.0)
    later, _ = make_trajectory(with_velocities=False, start=12.0)
    assert later.sample(10.0)[0] == pytest.approx(HOME)
    assert later.sample(12.5)[0] == pytest.approx(points[0].positions, abs=0.7)


def test_a_start_in_the_past_begins_in_the_middle():
    trajectory, points = make_trajectory(with_velocities=True, start=9.25)
    assert trajectory.sample(10.25)[0] == pytest.approx(points[1].positions)
