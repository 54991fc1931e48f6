"""φ by resolved rate: which way round a hand turns."""

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
def test_either_way_round_ends_at_the_same_rotation_and_the_nearer_is_taken(axis, angle, swept, size):
    turn = axis / np.linalg.norm(axis) * angle
    taken = nearer_rotation(turn, size * swept)
    assert np.allclose(Rotation.from_rotvec(taken).as_matrix(), Rotation.from_rotvec(turn).as_matrix(), atol=1e-9)
    other = turn * (1.0 - 2.0 * np.pi / angle)
    assert np.linalg.norm(taken - size * swept) == pytest.approx(
        min(np.linalg.norm(way - size * swept) for way in (turn, other))
    )


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_hand_that_must_turn_past_its_joint_limit_the_short_way_turns_the_long_way(side):
    """The last joint goes from one side of its range to the other: 3.6 rad, while 2.68 rad would lead out of it."""
    robot_model = load_robot("panda")
    safety = SafetyFilter(robot_model)
    phi = ResolvedRate(robot_model, safety)
    q, goal = np.array(robot_model.home), np.array(robot_model.home)
    q[6], goal[6] = side * -1.8, side * 1.8
    there = safety.tool(goal)
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
        q = q + PERIOD * phi.toward_pose(state, tool, pose_error(tool, there.position, there.rotation), 0.2, goal, now)
    tool = safety.tool(q)
    assert np.linalg.norm(rotation_error(tool.rotation, there.rotation)) < 0.01
    assert np.linalg.norm(tool.position - there.position) < 0.002
    assert q[6] == pytest.approx(goal[6], abs=0.02)
