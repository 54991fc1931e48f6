"""The node in a process of its own, over DDS: safe commands, diagnostics, markers, a second publisher, the end."""

import os
import signal
import time
from contextlib import nullcontext

import numpy as np
import pytest

from dualbrain.drivers.ros2 import dds_types as ros
from dualbrain.drivers.ros2.dds_node import RELIABLE, RELIABLE_NEWEST, DdsNode
from dualbrain.drivers.ros2.joint_order import JointStates
from dualbrain.drivers.ros2.problems import Level
from tests.drivers.ros2.dds_peer import COMMANDS, LOCAL, SAFE, Peer, running_node, take_markers
from tests.drivers.ros2.node_under_test import HOME, NAMES, PANDA, PERIOD, make_core, urdf_of

pytestmark = pytest.mark.realtime
SLOW = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.3]
ACCELERATIONS = np.array([joint.acceleration.value for joint in PANDA.joints])


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


class Recorder:
    """Records the safe commands of a node with the times at which they are sent."""

    def __init__(self, writer):
        self.guid, self.sent, self.times = writer.guid, [], []

    def write(self, message):
        self.sent.append(list(message.data))
        self.times.append(time.monotonic())


def moving_node(domain, **changes):
    """A node in this process whose arm moves at `SLOW`, and the record of its safe commands."""
    node = DdsNode(make_core(**changes), "dualbrain_filter", domain)
    node._safe = Recorder(node._safe)
    for step in range(40):
        now = 50.0 + step * PERIOD
        node._core.receive_command(SLOW, now, now)
        node._turn_begin = time.monotonic()
        node._send(node._core.receive_states(JointStates(NAMES, HOME.tolist(), node._last or [0.0] * 7, now), now, now))
    assert node._last == pytest.approx(SLOW, abs=1e-5)
    del node._safe.sent[:-1], node._safe.times[:-1]
    return node, node._safe


def test_without_a_clock_the_node_brakes_one_step_per_period_however_often_it_wakes_up(domain):
    node, record = moving_node(domain, use_sim_time=True)
    node._clock.receive(50.0 + 40 * PERIOD, time.monotonic() - 10.0)
    for _ in range(60):
        node._turn()
        time.sleep(0.001)
    assert len(record.sent) - 1 <= 1.0 + (record.times[-1] - record.times[0]) / PERIOD
    assert np.all(np.abs(np.diff(np.array(record.sent), axis=0)) <= 1.0001 * ACCELERATIONS * PERIOD)
    assert record.sent[-1] == [0.0] * 7
    diagnosis = node._core.diagnose(node._clock.elapsed)
    assert diagnosis.level is Level.STALE
    assert "/clock is silent" in diagnosis.message


@pytest.mark.parametrize("fault", [None, RuntimeError("the filter failed")])
def test_the_last_command_of_a_node_that_cannot_brake_to_rest_is_zero(domain, monkeypatch, fault):
    node, record = moving_node(domain)

    def brake(*arguments):
        if fault is not None:
            raise fault
        return SLOW

    monkeypatch.setattr(node._core, "brake", brake)
    monkeypatch.setattr("dualbrain.drivers.ros2.dds_node.MIN_STOP_TIME", 0.02)
    with pytest.raises(RuntimeError) if fault else nullcontext():
        node.run(lambda: True)
    assert record.sent[-1] == [0.0] * 7


def test_a_node_that_ends_brakes_within_the_limits_also_if_that_takes_longer(domain, monkeypatch):
    node, record = moving_node(domain)
    monkeypatch.setattr("dualbrain.drivers.ros2.dds_node.MIN_STOP_TIME", 0.0)
    node.run(lambda: True)
    assert record.sent[-1] == [0.0] * 7
    assert np.all(np.abs(np.diff(np.array(record.sent), axis=0)) <= 1.0001 * ACCELERATIONS * PERIOD)
    assert np.all(np.diff(record.times[:-1]) > 0.9 * PERIOD)
