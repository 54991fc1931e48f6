"""The other side of the node over DDS: an arm, its controller and a policy in this process, the node in another one."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
from cyclonedds.domain import DomainParticipant
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from dualbrain.drivers.ros2 import dds_types as ros
from dualbrain.drivers.ros2.dds_node import LATCHED, RELIABLE, RELIABLE_NEWEST, SENSOR_DATA
from dualbrain.drivers.ros2.problems import Level
from experiments.robots.ros2.rates import SITE
from tests.drivers.ros2.node_under_test import HOME, NAMES, PERIOD

COMMANDS, SAFE = "/policy/commands", "/velocity_controller/commands"
PARAMETERS = f"""
/**:
  ros__parameters:
    robot: panda
    period: {PERIOD}
    state_timeout: 0.05
    command_topic: {COMMANDS}
    safe_command_topic: {SAFE}
"""
LOCAL = """<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo'/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<Peers><Peer address='127.0.0.1'/></Peers><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex></Discovery>
</Domain></CycloneDDS>"""
"""Configuration of DDS on this machine alone, without multicast."""


@contextmanager
def running_node(folder, domain, *more, dds=LOCAL):
    """The command `dualbrain ros2 node` with the parameters `PARAMETERS` and the lines `more`; `dds` configures DDS."""
    (folder / "node.yaml").write_text(PARAMETERS + "".join(f"    {line}\n" for line in more))
    (folder / "site.toml").write_text(SITE)
    command = [sys.executable, "-m", "dualbrain", "ros2", "node", "--params", str(folder / "node.yaml")]
    command += ["--site", str(folder / "site.toml"), "--domain", str(domain)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, env=os.environ | {"CYCLONEDDS_URI": dds}, text=True)
    try:
        yield process
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=10.0)
    finally:
        process.kill()
        process.wait()
        process.stderr.close()
    assert process.returncode == 0, errors


class Peer:
    """An arm that follows its commands exactly, and a policy; `clock` (system time, scale) is that of ROS."""

    def __init__(self, domain):
        self.participant = DomainParticipant(domain)
        self._states = self.writer("/joint_states", ros.JointState, SENSOR_DATA)
        self._commands = self.writer(COMMANDS, ros.Float64MultiArray, RELIABLE)
        self._description = self.writer("/robot_description", ros.String, LATCHED)
        self._clock = self.writer("/clock", ros.Clock, RELIABLE)
        self._safe = self.reader(SAFE, ros.Float64MultiArray, RELIABLE_NEWEST)
        self._diagnostics = self.reader("/diagnostics", ros.DiagnosticArray, RELIABLE)
        self.markers = self.reader("/dualbrain_filter/markers", ros.MarkerArray, RELIABLE)
        self.q, self.v = HOME.copy(), np.zeros(7)
        self.received, self.status = 0, []
        self.simulated = None

    def writer(self, topic, kind, quality):
        """A publisher."""
        return DataWriter(
            self.participant, Topic(self.participant, ros.topic_name(topic), kind, qos=quality), qos=quality
        )

    def reader(self, topic, kind, quality):
        """A subscription."""
        return DataReader(
            self.participant, Topic(self.participant, ros.topic_name(topic), kind, qos=quality), qos=quality
        )

    def describe(self, urdf):
        """Publish a robot description."""
        self._description.write(ros.String(data=urdf))

    def run(self, seconds, command=None, states=True, names=NAMES, until=lambda: False):
        """Publish states and `command` every 5 ms, and move at the safe commands; stops early once `until()`."""
        end, due = time.monotonic() + seconds, time.monotonic()
        while time.monotonic() < end and not until():
            due = max(due + PERIOD, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
            now = time.time()
            if self.simulated is not None:
                self.simulated += PERIOD
                now = self.simulated
                self._clock.write(ros.Clock(clock=ros.Time.at(now)))
            if command is not None:
                self._commands.write(ros.Float64MultiArray(data=list(command)))
            if states:
                order = [NAMES.index(name) for name in names]
                self._states.write(
                    ros.JointState(
                        header=ros.Header(stamp=ros.Time.at(now)),
                        name=list(names),
                        position=self.q[order].tolist(),
                        velocity=self.v[order].tolist(),
                    )
                )
            self._receive()
            self.q = self.q + PERIOD * self.v

    def _receive(self):
        for message in _samples(self._safe):
            self.v = np.array(message.data)
            self.received += 1
        for message in _samples(self._diagnostics):
            self.status.extend(message.status)

    def wait_for(self, level, words, seconds=4.0, **run):
        """Run until a diagnostic status has this level and these words; returns it."""
        self.status.clear()
        self.run(seconds, until=lambda: self._with(level, words), **run)
        assert self._with(level, words), [(one.level, one.message) for one in self.status]
        return self._with(level, words)[0]

    def _with(self, level, words):
        return [one for one in self.status if one.level == level and words in one.message]

    def wait_for_motion(self, command, seconds=4.0):
        """Run until the arm moves at `command`, and a status comes that is no error; returns it."""

        def moves():
            return np.allclose(self.v, command, atol=1e-5) and self.status and self.status[-1].level < Level.ERROR

        self.status.clear()
        self.run(seconds, command, until=moves)
        assert moves(), (self.v, [(one.level, one.message) for one in self.status])
        return self.status[-1]


def _samples(reader):
    return [one for one in reader.take(N=64) if not isinstance(one, InvalidSample)]


def take_markers(peer):
    """The last markers that were published."""
    return _samples(peer.markers)[-1].markers
