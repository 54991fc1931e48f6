"""The node without DDS: commands become safe ones, and every unusable input brings the arm to rest with a diagnosis."""

import msgspec
import numpy as np
import pytest

from dualbrain.drivers.ros2.command_sources import TwistMessage
from dualbrain.drivers.ros2.joint_order import JointStates
from dualbrain.drivers.ros2.problems import Level
from dualbrain.drivers.ros2.trajectory import TrajectoryMessage, TrajectoryPoint
from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import load_robot
from dualbrain.safety.barriers.workspace import plane
from tests.drivers.ros2.node_under_test import CRATE, HOME, NAMES, PANDA, PERIOD, TABLE, Cell, make_core

SLOW = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.3]
"""Velocities that turn the flange, far from everything."""
ACCELERATIONS = np.array([joint.acceleration.value for joint in PANDA.joints])


def moving_cell(**changes):
    """A cell whose arm moves at a command."""
    cell = Cell(make_core(**changes))
    assert cell.run(0.5, SLOW) == pytest.approx(SLOW, abs=1e-5)
    cell.diagnose()
    return cell


def assert_rests(cell, level, *words):
    """The arm rests, within its acceleration limits on the way, and the diagnosis has the level and all words."""
    assert np.all(cell.v == 0.0)
    changes = np.diff(np.array(cell.sent), axis=0)
    assert np.all(np.abs(changes) <= 1.0001 * ACCELERATIONS * PERIOD)
    diagnosis = cell.diagnose()
    assert diagnosis.level is level, diagnosis
    assert "Remedy: " in diagnosis.message
    for word in words:
        assert word in diagnosis.message, diagnosis.message


def assert_recovers(cell):
    """With good inputs the arm moves again."""
    assert cell.run(1.0, SLOW) == pytest.approx(SLOW, abs=1e-5)
    cell.diagnose()
    cell.run(0.1, SLOW)
    assert cell.diagnose().level is Level.OK


# --- commands -------------------------------------------------------------------------------------------------------


def test_a_safe_command_passes_unchanged():
    cell = moving_cell()
    cell.run(0.1, SLOW)
    diagnosis = cell.diagnose()
    assert diagnosis.level is Level.OK
    assert diagnosis.message == "Commands pass unchanged."


def test_a_command_toward_an_obstacle_is_made_safe():
    cell = Cell()
    cell.states()
    cell.run(6.0, [0.6, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0])
    centres, radii, _ = cell.core.safety.spheres(cell.q, None)
    boxed = np.abs(centres - [0.45, 0.42, 0.3]) - [0.1, 0.1, 0.3]
    gaps = np.linalg.norm(np.maximum(boxed, 0.0), axis=1) - radii
    assert gaps.min() > -1e-3
    assert cell.diagnose().message == "Commands are made safe."


def test_commands_and_velocities_are_in_the_order_of_the_controller():
    order = NAMES[::-1]
    cell = Cell(make_core(joints=order))
    assert cell.run(0.5, SLOW[::-1]) == pytest.approx(SLOW[::-1], abs=1e-5)


def test_the_filter_begins_at_the_measured_velocity():
    cell = Cell()
    cell.v = np.array(SLOW)
    assert cell.states() == pytest.approx(SLOW - np.sign(SLOW) * ACCELERATIONS * PERIOD, abs=1e-5)


def test_joints_have_other_names_in_ros():
    names = [f"left_{name}" for name in NAMES]
    cell = Cell(make_core(joints=names, robot_joints=NAMES), names=names)
    assert cell.run(0.5, SLOW) == pytest.approx(SLOW, abs=1e-5)


def test_braking_along_the_path_is_an_option():
    cell = Cell(make_core(deviation="along_path"))
    wanted = np.array([0.3, 0.2, 0.0, 0.0, 0.0, 0.0, 0.0])
    for _ in range(30):
        cell.run(0.1, wanted.tolist())
        if np.linalg.norm(cell.v) > 1e-3:
            direction = cell.v / np.linalg.norm(cell.v)
            assert direction == pytest.approx(wanted / np.linalg.norm(wanted), abs=0.02)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ([0.1] * 6, ("has 6 values", "7 values")),
        ([0.1] * 8, ("has 8 values",)),
        ([], ("has 0 values",)),
        ([0.1, float("nan"), *[0.1] * 5], ("Value 1", "not finite")),
        ([float("inf")] * 7, ("Value 0", "not finite")),
    ],
)
def test_an_unusable_command_brings_the_arm_to_rest(command, words):
    cell = moving_cell()
    cell.command(command)
    cell.run(0.3, SLOW)
    assert_rests(cell, Level.ERROR, *words)
    assert_recovers(cell)


def test_a_silent_source_of_commands_brings_the_arm_to_rest():
    cell = moving_cell()
    cell.run(0.3)
    assert_rests(cell, Level.STALE, "No command on /dualbrain_filter/commands", "check the policy")
    assert_recovers(cell)


# --- joint states ---------------------------------------------------------------------------------------------------


def test_joint_states_may_have_any_order_and_more_joints():
    cell = moving_cell()
    names = ["finger", *NAMES[::-1]]
    for _ in range(20):
        cell.now += PERIOD
        cell.command(SLOW)
        sent = cell.states(names, [np.nan, *cell.q[::-1]], [np.nan, *cell.v[::-1]])
        assert sent == pytest.approx(SLOW, abs=1e-5)


def test_messages_of_a_gripper_are_ignored():
    cell = moving_cell()
    for _ in range(20):
        cell.states(["left_finger", "right_finger"], [0.0, 0.0], [])
        cell.run(PERIOD, SLOW)
    assert cell.diagnose().level is Level.OK


@pytest.mark.parametrize(
    ("states", "words"),
    [
        ({"names": NAMES[:-1]}, ("lacks panda_joint7", "`joints`")),
        ({"names": [*NAMES[:-1], "panda_joint1"]}, ("lacks panda_joint7",)),
        ({"names": [*NAMES, NAMES[0]]}, ("twice",)),
        ({"velocities": []}, ("0 velocities", "velocity state interfaces")),
        ({"positions": [0.0] * 6}, ("6 positions",)),
        ({"positions": [np.nan, *HOME[1:]]}, ("position of panda_joint1", "not finite")),
        ({"velocities": [0.0] * 6 + [np.inf]}, ("velocity of panda_joint7", "not finite")),
        ({"stamp": 0.0}, ("no time stamp",)),
        ({"stamp": 99.0}, ("older than the one before it",)),
        ({"stamp": 200.0}, ("in the future", "clocks")),
    ],
)
def test_unusable_joint_states_bring_the_arm_to_rest(states, words):
    cell = moving_cell()
    cell.run(0.4, SLOW, **states)
    assert_rests(cell, Level.ERROR, *words)
    assert_recovers(cell)


def test_one_joint_state_out_of_order_brings_the_arm_to_rest():
    cell = moving_cell()
    cell.states(stamp=cell.now - 0.02)
    cell.run(0.3, SLOW)
    assert_rests(cell, Level.ERROR, "0.020 s older")
    assert_recovers(cell)


def test_old_joint_states_bring_the_arm_to_rest():
    cell = moving_cell()
    for _ in range(80):
        cell.now += PERIOD
        cell.command(SLOW)
        sent = cell.core.receive_states(
            JointStates(NAMES, cell.q.tolist(), cell.v.tolist(), cell.now), cell.now, ros_now=cell.now + 0.4
        )
        sent = cell.core.idle(cell.now) if sent is None else sent
        cell.v = cell.v if sent is None else np.array(sent)
    assert np.all(cell.v == 0.0)
    assert "0.40 s old" in cell.diagnose().message


def test_silent_joint_states_bring_the_arm_to_rest():
    cell = moving_cell()
    cell.run(0.3, SLOW, silent=True)
    assert_rests(cell, Level.STALE, "No usable joint state", "joint_state_broadcaster")
    assert_recovers(cell)


def test_nothing_is_sent_before_the_first_joint_state():
    cell = Cell()
    cell.run(0.2, SLOW, silent=True)
    assert cell.sent == []
    diagnosis = cell.diagnose()
    assert diagnosis.level is Level.STALE
    assert "/joint_states" in diagnosis.message


@pytest.mark.parametrize(("interval", "jitter"), [(0.001, 0.0), (0.002, 0.0), (0.005, 0.0), (0.005, 0.002)])
def test_there_is_one_step_per_period(interval, jitter):
    cell = Cell()
    rng = np.random.default_rng(0)
    steps = []
    for index in range(round(1.0 / interval)):
        cell.now = 100.0 + interval * index + rng.uniform(0.0, jitter)
        if cell.states(velocities=[0.0] * 7) is not None:
            steps.append(cell.now)
    assert len(steps) == pytest.approx(1.0 / PERIOD, abs=1)
    assert np.diff(steps).min() > 0.4 * PERIOD
    assert np.diff(steps).max() < 1.6 * PERIOD


def test_steps_that_come_late_are_reported():
    cell = moving_cell(state_timeout=0.05)
    for _ in range(20):
        cell.now += 2 * PERIOD
        cell.command(SLOW)
        cell.states()
    diagnosis = cell.diagnose()
    assert diagnosis.level is Level.WARN
    assert "1.5 periods" in diagnosis.message
    assert "200 Hz" in diagnosis.message


# --- clock, writers, description ------------------------------------------------------------------------------------


@pytest.mark.parametrize("change", [-50.0, 50.0])
def test_a_jump_of_the_clock_brings_the_arm_to_rest(change):
    cell = moving_cell()
    cell.now += change
    cell.core.restart_clock("The clock jumped. Remedy: adjust it gradually", cell.now)
    cell.run(0.3, SLOW)
    assert_rests(cell, Level.ERROR, "The clock jumped")
    assert_recovers(cell)


def test_another_writer_of_the_safe_command_brings_the_arm_to_rest():
    cell = moving_cell()
    cell.core.report_writers(("Process 7 (teleop)",))
    cell.run(0.3, SLOW)
    assert_rests(cell, Level.ERROR, "Process 7 (teleop) also publishes", "/dualbrain_filter/safe_commands")
    cell.core.report_writers(())
    assert_recovers(cell)


def test_two_sources_of_commands_bring_the_arm_to_rest():
    cell = moving_cell()
    cell.core.report_writers((), ("Process 7 (teleop)", "Process 8 (policy)"))
    cell.run(0.3, SLOW)
    assert_rests(cell, Level.ERROR, "Process 7 (teleop) and Process 8 (policy) publish on", "multiplexer")
    cell.core.report_writers((), ("Process 8 (policy)",))
    assert_recovers(cell)
    cell = moving_cell(one_source=False)
    cell.core.report_writers((), ("Process 7 (teleop)", "Process 8 (policy)"))
    assert cell.run(0.3, SLOW) == pytest.approx(SLOW, abs=1e-5)


def test_without_a_robot_description_the_arm_rests():
    cell = Cell(make_core(check_description="exact"))
    cell.run(0.3, SLOW)
    assert_rests(cell, Level.ERROR, "No robot description", "robot_state_publisher")


# --- trajectories ---------------------------------------------------------------------------------------------------


def trajectory(*points, names=NAMES, start=0.0):
    return TrajectoryMessage(
        names, tuple(TrajectoryPoint(list(q), [] if v is None else list(v), time) for time, q, v in points), start
    )


GOAL = HOME + np.array([0.0, 0.0, 0.0, 0.1, 0.0, 0.1, 0.3])


def test_a_trajectory_is_followed_to_its_end_and_held():
    cell = Cell(make_core(command_type="trajectory"))
    cell.run(0.1)
    cell.command(trajectory((1.0, GOAL, np.zeros(7))))
    cell.run(0.5)
    assert np.abs(cell.v).max() > 0.1
    cell.run(2.0)
    assert cell.q == pytest.approx(GOAL, abs=2e-3)
    cell.run(1.0)
    assert cell.q == pytest.approx(GOAL, abs=1e-4)
    assert cell.diagnose().level is Level.OK


def test_a_trajectory_may_name_its_joints_in_any_order():
    cell = Cell(make_core(command_type="trajectory"))
    cell.run(0.1)
    cell.command(trajectory((1.0, GOAL[::-1], None), names=NAMES[::-1]))
    cell.run(3.0)
    assert cell.q == pytest.approx(GOAL, abs=1e-3)


def test_a_trajectory_into_an_obstacle_is_cancelled_when_the_arm_stays_behind():
    cell = Cell(make_core(command_type="trajectory", path_tolerance=0.1))
    cell.run(0.1)
    cell.command(trajectory((3.0, HOME + np.array([0.8, 0.8, 0.0, 0.0, 0.0, 0.0, 0.0]), None)))
    cell.run(4.0)
    assert_rests(cell, Level.ERROR, "beside its trajectory", "cancelled")


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (trajectory((1.0, GOAL[:6], None), names=NAMES[:6]), ("lacks panda_joint7",)),
        (trajectory((1.0, [*GOAL, 0.0], None), names=[*NAMES, "elbow"]), ("unknown joint 'elbow'",)),
        (trajectory((1.0, GOAL[:6], None)), ("Point 0", "6 positions")),
        (trajectory((1.0, GOAL, None), (2.0, GOAL, np.zeros(7))), ("Point 1", "7 velocities")),
        (trajectory((1.0, GOAL * np.nan, None)), ("Point 0", "not finite")),
        (trajectory((1.0, GOAL, None), (1.0, HOME, None)), ("do not increase",)),
        (trajectory(*((1.0 + k, HOME, None) for k in range(1001))), ("1001 points", "1 to 1000")),
        (trajectory((-1.0, HOME, None), (1.0, HOME, None)), ("do not increase",)),
    ],
)
def test_an_unusable_trajectory_is_refused(message, words):
    cell = Cell(make_core(command_type="trajectory"))
    cell.run(0.1)
    cell.command(message)
    cell.run(0.3)
    assert_rests(cell, Level.ERROR, *words)


@pytest.mark.parametrize(("late", "refused"), [(0.9, False), (1.1, True), (60.0, True)])
def test_a_trajectory_that_ended_before_it_came_moves_nothing(late, refused):
    cell = Cell(make_core(command_type="trajectory"))
    cell.run(0.1)
    cell.command(trajectory((0.5, HOME + 0.5 * (GOAL - HOME), None), (1.0, GOAL, None), start=cell.now - late))
    cell.run(0.3)
    if refused:
        assert np.array_equal(cell.q, HOME)
        assert_rests(cell, Level.ERROR, "ended", "before it came")
    else:
        assert not np.array_equal(cell.q, HOME)


def test_a_trajectory_during_the_rest_after_an_unusable_input_is_reported_and_ignored():
    cell = Cell(make_core(command_type="trajectory"))
    cell.run(0.1)
    cell.command(trajectory((1.0, GOAL * np.nan, None)))
    cell.run(0.2)
    cell.diagnose()
    cell.command(trajectory())
    assert cell.diagnose().level is Level.OK
    cell.command(trajectory((1.0, GOAL, None)))
    cell.run(0.5)
    assert_rests(cell, Level.WARN, "while the arm rests", "send it again", "0.5 s")
    cell.command(trajectory((1.0, GOAL, None)))
    cell.run(2.0)
    assert cell.q == pytest.approx(GOAL, abs=2e-3)


def test_an_empty_trajectory_ends_the_motion():
    cell = Cell(make_core(command_type="trajectory"))
    cell.run(0.1)
    cell.command(trajectory((1.0, GOAL, None)))
    cell.run(0.5)
    cell.command(trajectory())
    assert np.all(cell.run(0.5) == 0.0)
    assert cell.diagnose().level is Level.OK


# --- twists ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("frame", ["panda_link0", "hand"])
def test_a_twist_moves_the_tool_in_the_axes_of_its_frame(frame):
    cell = Cell(make_core(command_type="twist", base_frame="panda_link0", tool_frame="hand"))
    cell.run(0.4, TwistMessage((0.0, 0.0, 0.05), (0.0, 0.0, 0.0), frame))
    tool = cell.core.safety.tool(cell.q)
    linear = (tool.jacobian @ cell.v)[:3]
    expected = np.array([0.0, 0.0, 0.05]) if frame == "panda_link0" else tool.rotation @ [0.0, 0.0, 0.05]
    assert linear == pytest.approx(expected, abs=2e-3)


def test_a_twist_in_another_frame_is_refused():
    cell = Cell(make_core(command_type="twist", base_frame="panda_link0"))
    cell.run(0.3, TwistMessage((0.0, 0.0, 0.05), (0.0, 0.0, 0.0), "camera"))
    assert_rests(cell, Level.ERROR, "'camera'", "'panda_link0'")


def test_a_twist_that_is_not_finite_is_refused():
    cell = Cell(make_core(command_type="twist", base_frame="panda_link0"))
    cell.run(0.3, TwistMessage((0.0, np.nan, 0.05), (0.0, 0.0, 0.0), "panda_link0"))
    assert_rests(cell, Level.ERROR, "Value 1 of the twist")


# --- set-up ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"joints": NAMES[:6]}, "robot_joints"),
        ({"joints": [*NAMES[:6], "elbow"]}, "elbow"),
        ({"joints": ["a"] * 7, "robot_joints": NAMES}, "7 different names"),
        ({"command_type": "twist"}, "base_frame"),
        ({"period": 0.02}, "control period"),
        ({"robot": "mobile_panda"}, "mobile base"),
    ],
)
def test_a_wrong_set_up_is_an_error(changes, words):
    obstacles = (TABLE,) if "robot" not in changes else (plane("floor", (0, 0, -1.0), (0, 0, 1)),)
    with pytest.raises(ConfigurationError, match=words):
        make_core(obstacles, **changes)


def test_a_node_without_obstacles_or_with_moving_ones_is_an_error():
    with pytest.raises(ConfigurationError, match="There is no obstacle"):
        make_core(())
    with pytest.raises(ConfigurationError, match="crate moves"):
        make_core((msgspec.structs.replace(CRATE, static=False),))


def test_other_robots_have_their_own_joints():
    ur5e = load_robot("ur5e")
    cell = Cell(
        make_core((plane("table", (0, 0, -0.02), (0, 0, 1), parts=("arm", "hand")),), robot="ur5e"),
        q=ur5e.home,
        names=[joint.name for joint in ur5e.joints],
    )
    assert cell.run(0.5, [0.0] * 5 + [0.2]) == pytest.approx([0.0] * 5 + [0.2], abs=1e-5)
