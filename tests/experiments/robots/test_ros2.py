"""The ROS 2 node beside a real rclpy process (slow, only where its environment was created)."""

import json
import os
import subprocess
import time

import numpy as np
import pytest

from dualbrain.drivers.ros2.problems import Level
from dualbrain.errors import MissingDependencyError
from experiments.robots.ros2.virtual_environment import ENVIRONMENT, peer_command, peer_variables
from tests.drivers.ros2.dds_peer import running_node
from tests.drivers.ros2.node_under_test import HOME, NAMES, PANDA, urdf_of

pytestmark = [pytest.mark.slow, pytest.mark.realtime]
COMMAND = [0.0, 0.0, 0.0, 0.0, 0.0, 0.05, 0.1]


def run_peer(folder, do, *parameters):
    """Run the node and the peer; returns what the peer measured."""
    try:
        ENVIRONMENT.interpreter()
    except MissingDependencyError as missing:
        pytest.skip(str(missing))
    domain = 1 + (os.getpid() * 7 + int(time.monotonic())) % 200
    job = {"joints": list(NAMES), "home": HOME.tolist(), "urdf": urdf_of(PANDA), "command": COMMAND, "do": do}
    with running_node(folder, domain, *parameters, dds=""):
        done = subprocess.run(
            peer_command(json.dumps(job)), env=peer_variables(domain), capture_output=True, text=True, check=False
        )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def assert_moves(found):
    assert found["v"] == pytest.approx(COMMAND, abs=1e-5)
    assert found["received"] > 100
    assert found["status"][-1][0] < Level.ERROR


def assert_rests(found, level, words):
    assert np.all(np.array(found["v"]) == 0.0)
    assert [text for number, text in found["status"] if number == level and words in text and "Remedy" in text], found


def test_good_and_bad_input_of_rclpy(tmp_path):
    found = run_peer(tmp_path, "inputs")
    assert_moves(found["normal"])
    assert_moves(found["permuted"])
    assert_rests(found["missing"], Level.ERROR, "joint_states lacks panda_joint7")
    assert_rests(found["nan"], Level.ERROR, "position of panda_joint1 in joint_states is not finite")
    assert_rests(found["no velocity"], Level.ERROR, "has 0 velocities")
    assert_rests(found["stale"], Level.ERROR, "0.50 s old")
    assert_rests(found["silent"], Level.STALE, "No usable joint state")
    for name in ("missing", "nan", "no velocity", "stale", "silent"):
        assert_moves(found[f"after {name}"])
    assert_rests(found["nan command"], Level.ERROR, "Value 0 of the command is not finite")
    assert_rests(found["silent policy"], Level.STALE, "No command on /policy/commands")
    assert_rests(found["second publisher"], Level.ERROR, "also publishes on /velocity_controller/commands")
    assert_moves(found["after second publisher"])
    assert {(frame, text, count) for frame, text, count in found["markers"]} == {
        ("base", "table", 2),
        ("base", "crate", 2),
    }


def test_a_trajectory_of_rclpy(tmp_path):
    found = run_peer(tmp_path, "trajectory", "command_type: trajectory")
    assert found["q"] == pytest.approx(found["goal"], abs=1e-3)
    assert found["trajectory"]["status"][-1][0] < Level.ERROR


def test_a_twist_of_rclpy_under_a_simulated_clock(tmp_path):
    found = run_peer(tmp_path, "twist", "command_type: twist", "base_frame: base", "use_sim_time: true")
    assert np.abs(found["twist"]["v"]).max() > 0.02
    assert found["twist"]["status"][-1][0] < Level.ERROR
