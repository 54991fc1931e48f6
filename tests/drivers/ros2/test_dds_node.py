"""The node in a process of its own, over DDS: safe commands, diagnostics, markers, a second publisher, the end."""

import os
import signal
import time

import numpy as np
import pytest

from dualbrain.drivers.ros2 import dds_types as ros
from dualbrain.drivers.ros2.dds_node import RELIABLE, RELIABLE_NEWEST
from dualbrain.drivers.ros2.problems import Level
from tests.drivers.ros2.dds_peer import COMMANDS, LOCAL, SAFE, Peer, running_node, take_markers
from tests.drivers.ros2.node_under_test import NAMES, PANDA, urdf_of

pytestmark = pytest.mark.realtime
SLOW = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.3]


@pytest.fixture
def domain(monkeypatch):
    """A DDS domain of this test, on this machine alone."""
    monkeypatch.setenv("CYCLONEDDS_URI", LOCAL)
    return 1 + (os.getpid() * 7 + int(time.monotonic())) % 200


def test_the_node_guards_reports_and_brings_the_arm_to_rest(tmp_path, domain):
    with running_node(tmp_path, domain) as process:
        peer = Peer(domain)
        peer.wait_for(Level.ERROR, "No robot description", command=SLOW, seconds=10.0)
        assert np.all(peer.v == 0.0)

        peer.describe(urdf_of(PANDA))
        status = peer.wait_for_motion(SLOW)
        assert status.name == "dualbrain_filter: safety filter"
        assert status.hardware_id == "panda"
        assert dict((one.key, one.value) for one in status.values)["robot_description"].endswith("kinematics agree")
        peer.run(0.2, SLOW, names=NAMES[::-1])
        assert peer.v == pytest.approx(SLOW, abs=1e-5)
        markers = take_markers(peer)
        assert {marker.text for marker in markers} == {"table", "crate"}
        assert {marker.header.frame_id for marker in markers} == {"base"}

        peer.wait_for(Level.STALE, "No command on /policy/commands")
        assert np.all(peer.v == 0.0)

        other = peer.writer(SAFE, ros.Float64MultiArray, RELIABLE_NEWEST)
        status = peer.wait_for(Level.ERROR, "also publishes on /velocity_controller/commands", command=SLOW)
        assert f"Process {os.getpid()}" in status.message
        assert np.all(peer.v == 0.0)
        del other

        peer.wait_for_motion(SLOW)
        other = peer.writer(COMMANDS, ros.Float64MultiArray, RELIABLE)
        peer.wait_for(Level.ERROR, "publish on /policy/commands", command=SLOW)
        assert np.all(peer.v == 0.0)
        del other

        peer.wait_for_motion(SLOW)
        process.send_signal(signal.SIGTERM)
        peer.run(0.5, SLOW)
        assert np.all(peer.v == 0.0)
        assert process.wait(timeout=10.0) == 0


def test_silent_joint_states_and_a_simulated_clock(tmp_path, domain):
    with running_node(tmp_path, domain, "use_sim_time: true", "check_description: none"):
        peer = Peer(domain)
        peer.simulated = 50.0
        peer.wait_for_motion(SLOW, seconds=10.0)
        assert peer.v == pytest.approx(SLOW, abs=1e-5)
        peer.wait_for(Level.STALE, "No usable joint state", command=SLOW, states=False)
        assert np.all(peer.v == 0.0)
        peer.wait_for_motion(SLOW)
        peer.simulated = 10.0
        peer.wait_for(Level.ERROR, "The clock jumped", command=SLOW)
        peer.wait_for_motion(SLOW)
        assert peer.v == pytest.approx(SLOW, abs=1e-5)
