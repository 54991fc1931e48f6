"""Resolved-rate control: the direction in which the hand rotates."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dualbrain.core.geometry.rotations import rotation_error
from dualbrain.robots.interface import RobotState
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.skills.kinematics.resolved_rate import ResolvedRate, nearer_rotation, pose_error

PERIOD = 1e-3
AXIS = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array).filter(lambda a: np.linalg.norm(a) > 0.1)


@settings(deadline=None)
@given(axis=AXIS, angle=st.floats(0.1, np.pi), swept=AXIS, size=st.floats(0.0, 6.0))
def test_both_directions_end_at_the_same_rotation_and_the_nearer_is_taken(axis, angle, swept, size):
    turn = axis / np.linalg.norm(axis) * angle
    taken = nearer_rotation(turn, size * swept)
    assert np.allclose(Rotation.from_rotvec(taken).as_matrix(), Rotation.from_rotvec(turn).as_matrix(), atol=1e-9)
    other = turn * (1.0 - 2.0 * np.pi / angle)
    assert np.linalg.norm(taken - size * swept) == pytest.approx(
        min(np.linalg.norm(candidate - size * swept) for candidate in (turn, other))
    )


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_hand_whose_short_rotation_would_exceed_a_joint_limit_takes_the_long_one(side):
    """The last joint moves by 3.6 rad inside its range; the shorter rotation by 2.68 rad would leave the range."""
    robot_model = load_robot("panda")
    safety = SafetyFilter(robot_model)
    phi = ResolvedRate(robot_model, safety)
    q, goal = np.array(robot_model.home), np.array(robot_model.home)
    q[6], goal[6] = side * -1.8, side * 1.8
    target = safety.tool(goal)
    for k in range(6000):
        now = k * PERIOD
        tool = safety.tool(q)
        state = RobotState(
            stamp=now,
            sequence=k,
            q=q,
            v=np.zeros(robot_model.n),
            opening=0.04,
            finger_forces=(0.0, 0.0),
            drive_enabled=True,
        )
        q = q + PERIOD * phi.toward_pose(
            state, tool, pose_error(tool, target.position, target.rotation), 0.2, goal, now
        )
    tool = safety.tool(q)
    assert np.linalg.norm(rotation_error(tool.rotation, target.rotation)) < 0.01
    assert np.linalg.norm(tool.position - target.position) < 0.002
    assert q[6] == pytest.approx(goal[6], abs=0.02)
