"""The parts of experiment `robosuite_tasks` that need no robosuite: messages, monitor, policies, obstacles, tables."""

import dataclasses
import os
import threading

import numpy as np
import pytest

from dualbrain.core.geometry.rotations import matrix_to_quaternion, quaternion_to_matrix
from dualbrain.core.geometry.shapes import Box, HalfSpace, Pose
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from experiments.engine.experiment import Options
from experiments.engine.pipe_protocol import HEADER, MAX_MESSAGE_BYTES, PipeError, receive, send
from experiments.robots.robosuite import suite_process
from experiments.robots.robosuite.episode import MAX_JOINT_SPEED as POLICY_MAX_JOINT_SPEED
from experiments.robots.robosuite.episode import EpisodeRecord
from experiments.robots.robosuite.limit_monitor import LOWER, MAX_JOINT_SPEED, UPPER, LimitMonitor
from experiments.robots.robosuite.policies import SPEED_PROFILES, TASKS, BangBangPolicy, WaypointPolicy, grasp_rotation
from experiments.robots.robosuite.scene import static_obstacles
from experiments.robots.robosuite.suite_process import SuiteObject, SuiteProcess
from experiments.robots.robosuite.tracking import ACCELERATION_SHARES, SPEED_SHARES, check_agreement, derated_robot
from experiments.robots.robosuite.virtual_environment import ENVIRONMENT
from experiments.robots.robosuite_tasks import CONDITIONS, CONTROL_CONDITIONS, N_SEEDS, RobosuiteTasks

PERIOD = 0.002
CUBES = {
    "Lift": {"cube": Pose((0.55, 0.02, -0.09), (0.9, 0.0, 0.0, 0.43588989))},
    "Stack": {"cubeA": Pose((0.58, 0.03, -0.092)), "cubeB": Pose((0.5, -0.05, -0.087))},
}


@pytest.fixture
def pipe():
    ends = os.pipe()
    yield ends
    for end in ends:
        os.close(end)


@pytest.mark.parametrize(
    "message", [{"do": "open", "seed": 3, "text": "ü"}, {}, np.zeros(0), np.array([1.5, -np.inf, np.nan, 1e-300])]
)
def test_a_message_arrives_as_it_was_sent(pipe, message):
    send(pipe[1], message)
    received = receive(pipe[0], 1.0)
    if isinstance(message, dict):
        assert received == message
    else:
        assert received.tobytes() == message.tobytes()


def test_a_message_longer_than_the_pipe_arrives_whole(pipe):
    numbers = np.arange(100_000.0)
    writer = threading.Thread(target=send, args=(pipe[1], numbers))
    writer.start()
    assert np.array_equal(receive(pipe[0], 1.0), numbers)
    writer.join()


def test_a_timeout_an_end_and_an_invalid_message_are_distinguished():
    read, write = os.pipe()
    with pytest.raises(PipeError, match="no message within"):
        receive(read, 0.01)
    os.write(write, HEADER.pack(b"A", MAX_MESSAGE_BYTES + 1))
    with pytest.raises(PipeError, match="invalid message header"):
        receive(read, 1.0)
    os.write(write, HEADER.pack(b"J", 10) + b"{")
    os.close(write)
    with pytest.raises(PipeError, match="has ended"):
        receive(read, 1.0)
    os.close(read)


def test_the_monitor_has_the_data_sheets_limits():
    joints = load_robot("panda").joints
    assert [j.lower.value for j in joints] == LOWER.tolist()
    assert [j.upper.value for j in joints] == UPPER.tolist()
    assert [j.velocity.value for j in joints] == MAX_JOINT_SPEED.tolist() == POLICY_MAX_JOINT_SPEED.tolist()


def test_breaches_are_counted_once_with_their_peak_and_duration():
    monitor, middle, still = LimitMonitor(), 0.5 * (LOWER + UPPER), np.zeros(7)
    fast, beyond = still.copy(), UPPER.copy()
    fast[3], beyond[1] = -3.0, UPPER[1] + 0.02
    monitor.update(0.0, middle, 1.009 * MAX_JOINT_SPEED, {("finger", "table"): 0.9})
    assert monitor.breaches() == []
    monitor.update(0.002, middle, fast, {("finger", "table"): 40.0})
    monitor.update(0.004, beyond, fast * 0.8, {("finger", "table"): 90.0, ("hand", "table"): 2.0})
    monitor.update(0.5, middle, still, {("finger", "table"): 5.0})
    found = [(b["kind"], b["between"], b["start"], b["duration"], b["peak"]) for b in monitor.breaches()]
    assert found == [
        ("joint_velocity", ["joint4"], 0.002, 0.002, 3.0),
        ("touch", ["finger", "table"], 0.002, 0.002, 90.0),
        ("joint_position", ["joint2"], 0.004, 0.0, 0.02),
        ("touch", ["hand", "table"], 0.004, 0.0, 2.0),
        ("touch", ["finger", "table"], 0.5, 0.0, 5.0),
    ]


def simulate(task, name, steps=6000):
    """A policy with ideal joints and cubes that follow closed fingers; returns controls and waypoints as well."""
    safety, cubes = SafetyFilter(load_robot("panda")), dict(CUBES[task])
    q = np.array([0.0, 0.19, 0.0, -2.6, 0.0, 2.95, 0.785])
    policy = WaypointPolicy(TASKS[task](name == "hasty"), SPEED_PROFILES[name], MAX_JOINT_SPEED, q, PERIOD)
    controls, met, target = [], [], min(cubes)
    for k in range(steps):
        tool = safety.tool(q)
        controls.append(policy.nominal(k * PERIOD, q, tool, cubes))
        if not met or met[-1][0] != policy.waypoint.name:
            met.append((policy.waypoint.name, tool.position.copy(), tool.rotation.copy()))
        if policy.waypoint.closed:
            cubes[target] = Pose(tuple((tool.position - (0.0, 0.0, 0.0)).tolist()), cubes[target].quaternion)
        if policy.done:
            break
        q = q + PERIOD * np.clip(controls[-1], -MAX_JOINT_SPEED, MAX_JOINT_SPEED)
    return policy, np.array(controls), met, cubes


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("name", SPEED_PROFILES)
def test_a_policy_grasps_the_cube_from_above_and_places_it(task, name):
    policy, controls, met, cubes = simulate(task, name)
    assert policy.done
    assert [point for point, _, _ in met] == [point.name for point in TASKS[task](name == "hasty")]
    at = {point: (position, rotation) for point, position, rotation in met}
    start = CUBES[task][min(cubes)]
    assert np.linalg.norm(at["close"][0] - np.array(start.position)) < 0.012
    assert at["close"][1][2, 2] == pytest.approx(-1.0, abs=0.02)
    sides = quaternion_to_matrix(start.quaternion)[:, :2].T @ at["close"][1][:, 1]
    assert np.max(np.abs(sides)) == pytest.approx(1.0, abs=0.01)
    if task == "Lift":
        assert cubes["cube"].position[2] > start.position[2] + 0.09
    else:
        assert np.linalg.norm(np.subtract(cubes["cubeA"].position, cubes["cubeB"].position)[:2]) < 0.01
    share = np.max(np.abs(controls) / MAX_JOINT_SPEED)
    assert share <= 0.6 + 1e-9 if name == "careful" else share > 2.0


def test_the_grasp_rotation_is_the_nearest_across_two_sides():
    rng = np.random.default_rng(0)
    for _ in range(50):
        yaw, now = rng.uniform(-np.pi, np.pi, 2)
        c, s = np.cos(now), np.sin(now)
        rotation = np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])
        cube = Pose((0.5, 0.0, 0.0), (np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)))
        goal = grasp_rotation(rotation, cube)
        assert np.allclose(goal.T @ goal, np.eye(3))
        assert np.linalg.det(goal) == pytest.approx(1.0)
        assert np.max(np.abs(quaternion_to_matrix(cube.quaternion)[:, 0] @ goal[:, :2])) == pytest.approx(1.0)
        assert rotation[:, 0] @ goal[:, 0] >= np.cos(np.pi / 4) - 1e-9


def test_bang_bang_is_seeded_and_at_full_speed():
    def controls(seed):
        policy = BangBangPolicy(MAX_JOINT_SPEED, "cube", seed, 2.0)
        return np.array([policy.nominal(t * PERIOD, None, None, None) for t in range(1001)]), policy.done

    (one, done), (same, _), (other, _) = controls(1), controls(1), controls(2)
    assert done
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)
    assert np.array_equal(np.abs(one), np.broadcast_to(MAX_JOINT_SPEED, one.shape))


def test_fixed_objects_become_obstacles_and_cubes_do_not():
    level = (1.0, 0.0, 0.0, 0.0)
    objects = [
        SuiteObject(name="floor", solid="plane", size=(3.0, 3.0, 0.1), position=(0.0, 0.0, -0.9), quaternion=level),
        SuiteObject(name="table", solid="box", size=(0.4, 0.4, 0.025), position=(0.56, 0.0, -0.137), quaternion=level),
        SuiteObject(name="mount", solid="box", size=(0.1, 0.2, 0.2), position=(-0.3, 0.0, -0.4), quaternion=level),
        SuiteObject(
            name="mount", solid="cylinder", size=(0.18, 0.31, 0.0), position=(0.0, 0.0, -0.3), quaternion=level
        ),
        SuiteObject(name="cubeA", solid="box", size=(0.02, 0.02, 0.02), position=(0.5, 0.0, -0.09), quaternion=level),
    ]
    found = static_obstacles(objects)
    assert [type(one.shape) for one in found] == [HalfSpace, Box, Box, Box]
    assert found[3].shape.half_extents == (0.18, 0.18, 0.31)
    assert len({one.name for one in found}) == 4


def test_the_two_arm_models_must_agree():
    safety, rng = SafetyFilter(load_robot("panda")), np.random.default_rng(1)
    tools = [safety.tool(q) for q in rng.uniform(-1.0, 1.0, (20, 7))]
    turn = quaternion_to_matrix(matrix_to_quaternion(quaternion_to_matrix((0.9, 0.1, 0.2, 0.3))))
    sites = np.array(
        [[*(tool.position + tool.rotation @ (0.0, 0.0, -0.006)), *(tool.rotation @ turn).ravel()] for tool in tools]
    )
    apart, turned = check_agreement(sites, tools)
    assert apart < 1e-6
    assert turned < 1e-6
    sites[7, 0] += 2e-3
    with pytest.raises(ConfigurationError, match=r"2\.00 mm"):
        check_agreement(sites, tools)


def test_the_filter_is_derated_relative_to_the_data_sheet():
    original, derated = load_robot("panda"), derated_robot(PERIOD)
    assert derated.period == PERIOD
    for joint, one, speed, acceleration in zip(
        original.joints, derated.joints, SPEED_SHARES, ACCELERATION_SHARES, strict=True
    ):
        assert one.velocity.value == pytest.approx(speed * joint.velocity.value)
        assert one.acceleration.value == pytest.approx(acceleration * joint.acceleration.value)
    SafetyFilter(derated)


def test_metrics_are_shares_of_the_data_sheet_and_report_no_error():
    robot_model, record = derated_robot(PERIOD), EpisodeRecord(delta=[0.0, 1.0], status=[0, 1])
    for k in range(2):
        record.q.append(np.full(7, k * PERIOD))
        record.v.append(np.ones(7))
        record.u.append(2.0 * MAX_JOINT_SPEED)
    metrics = record.metrics(robot_model)
    assert metrics["asked"] == 2.0
    assert metrics["speed"] == pytest.approx(1.0 / MAX_JOINT_SPEED.min(), abs=1e-4)
    assert metrics["delta"] == 0.5
    assert metrics["status"] == [1, 1, 0, 0, 0]
    assert "error" not in metrics


def test_a_missing_environment_is_reported_with_the_command(tmp_path, monkeypatch):
    moved = dataclasses.replace(ENVIRONMENT, folder=tmp_path)
    with pytest.raises(MissingDependencyError, match=ENVIRONMENT.command):
        moved.interpreter()
    monkeypatch.setattr(suite_process, "ENVIRONMENT", moved)
    with pytest.raises(MissingDependencyError, match="The virtual environment of robosuite is missing"):
        SuiteProcess()
    assert all("==" in package for package in ENVIRONMENT.packages)


def test_every_condition_has_all_seeds_and_a_prefix_has_all_conditions_with_a_task(tmp_path):
    units = RobosuiteTasks().units(Options(tmp_path, ""))
    conditions = [(u.parameters["task"], u.parameters["policy"], u.parameters["how"]) for u in units]
    main, controls = (
        {(task, policy, mode) for task, policy, modes in group for mode in modes}
        for group in (CONDITIONS, CONTROL_CONDITIONS)
    )
    assert all(conditions.count(one) == N_SEEDS for one in main | controls)
    assert set(conditions[: N_SEEDS * len(main) // 4]) == main
    assert set(conditions[N_SEEDS * len(main) :]) == controls


def sample_row(unit, **changed):
    row = {
        "key": unit.key,
        **unit.parameters,
        "success": True,
        "first_success": 1.0,
        "breaches": [],
        "saturated": 0.0,
        "time": 3.0,
        "ended": "",
        "pushed": 0.0,
        "apart": 1e-7,
        "asked": 0.5,
        "speed": 0.5,
        "strayed": 1e-4,
        "steps": 100,
        "lag": 0.002,
        "allowed_error": 1e-3,
        "versions": {"robosuite": "1"},
    }
    if unit.parameters["how"] == "filtered":
        row |= {"delta": 0.1, "h_min": 0.002, "status": [60, 40, 0, 0, 0]}
    return row | changed


def test_the_report_counts_and_names_exceptions(tmp_path):
    experiment = RobosuiteTasks()
    rows = [sample_row(unit) for unit in experiment.units(Options(tmp_path, ""))]
    assert "No filtered episode failed or exceeded a limit." in "\n".join(experiment.report(rows))
    contact = {"kind": "touch", "between": ["finger", "table"], "start": 1.0, "duration": 0.1, "peak": 80.0}
    first = next(k for k, row in enumerate(rows) if row["how"] == "filtered" and row["task"] == "Stack")
    rows[first] |= {"breaches": [contact], "success": False}
    text = "\n".join(experiment.report(rows))
    assert "touch finger and table 80 N at 1.00 s" in text
    assert "19 of 20" in text
    assert "touch 80 N" in experiment.summarize_row(rows[first])
    assert experiment.report(rows[:1])
