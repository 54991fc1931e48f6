"""An arm with its controller and a policy as real rclpy nodes: good and bad input for the filter node, and latencies.

Runs in the environment of `virtual_environment`, without dualbrain: python rclpy_peer.py JOB, where JOB is JSON with
`joints`, `home`, `urdf`, `command` (velocities), `do` ("inputs", "trajectory", "twist" or "rate") and for "rate" `rate`
[Hz] and `seconds`. It prints one line of JSON: for every scenario the velocities at its end and the diagnostics.
"""

import json
import sys
import time

import rclpy
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.time import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from visualization_msgs.msg import MarkerArray

COMMANDS, SAFE = "/policy/commands", "/velocity_controller/commands"
PERIOD = 0.005
SCENARIO_SECONDS = 2.6
"""Longer than two diagnostic messages."""
READY_SECONDS = 30.0
ERROR = 2
"""`diagnostic_msgs/DiagnosticStatus.ERROR`."""
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Peer:
    """The nodes `arm` and `policy` in one process, and the last messages of the filter node."""

    def __init__(self, job):
        self.job, self.names = job, job["joints"]
        self.q, self.v = list(job["home"]), [0.0] * len(job["home"])
        self.node = rclpy.create_node("arm")
        self.states = self.node.create_publisher(JointState, "/joint_states", qos_profile_sensor_data)
        self.description = self.node.create_publisher(String, "/robot_description", LATCHED)
        self.node.create_subscription(Float64MultiArray, SAFE, self._receive, 10)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._diagnose, 10)
        self.node.create_subscription(MarkerArray, "/dualbrain_filter/markers", self._mark, 10)
        self.received, self.received_at, self.status, self.markers = 0, 0.0, [], []
        self.clock = None
        if job["do"] == "twist":
            self.clock = self.node.create_publisher(Clock, "/clock", 10)
        self.now = 100.0 if self.clock else 0.0
        self.description.publish(String(data=job["urdf"]))

    def _receive(self, message):
        self.v, self.received, self.received_at = list(message.data), self.received + 1, time.perf_counter()

    def _diagnose(self, message):
        self.status += [(one.level[0], one.message) for one in message.status]

    def _mark(self, message):
        self.markers = [(one.header.frame_id, one.text, len(one.points)) for one in message.markers]

    def publish_states(self, names=None, age=0.0, **entries):
        """Publish the joint states, with other `entries` (position, velocity), order of names or stamp."""
        names = names or self.names
        index = [self.names.index(name) if name in self.names else None for name in names]
        message = JointState(name=names)
        message.position = entries.get("position", [0.0 if i is None else self.q[i] for i in index])
        message.velocity = entries.get("velocity", [0.0 if i is None else self.v[i] for i in index])
        now = self.now if self.clock else time.time()
        message.header.stamp = Time(seconds=0, nanoseconds=int(1e9 * (now - age))).to_msg()
        self.states.publish(message)

    def run(self, seconds, publish_command, **states):
        """Publish states (unless `silent`) and commands every 5 ms for `seconds`, and move at the safe commands."""
        end, due = time.perf_counter() + seconds, time.perf_counter()
        while time.perf_counter() < end:
            due = max(due + PERIOD, time.perf_counter())
            if self.clock:
                self.now += PERIOD
                self.clock.publish(Clock(clock=Time(seconds=0, nanoseconds=int(1e9 * self.now)).to_msg()))
            publish_command()
            if not states.get("silent"):
                self.publish_states(**states)
            while (left := due - time.perf_counter()) > 0.0:
                rclpy.spin_once(self.node, timeout_sec=left)
            self.q = [q + PERIOD * v for q, v in zip(self.q, self.v, strict=True)]

    def wait_until_ready(self, publish_command):
        """Run until the filter node has accepted the robot description, at most `READY_SECONDS`."""
        end = time.perf_counter() + READY_SECONDS
        while time.perf_counter() < end and not (self.status and self.status[-1][0] < ERROR):
            self.run(0.5, publish_command)

    def scenario(self, publish_command, seconds=SCENARIO_SECONDS, **states):
        """The end of a scenario: velocities, number of safe commands, diagnostics."""
        self.status, self.received = [], 0
        self.run(seconds, publish_command, **states)
        return {"v": self.v, "received": self.received, "status": self.status}


def inputs(peer):
    """Velocity commands with good and bad joint states, a silent policy, and a second publisher."""
    publisher = peer.node.create_publisher(Float64MultiArray, COMMANDS, 10)

    def send():
        publisher.publish(Float64MultiArray(data=peer.job["command"]))

    def send_nan():
        publisher.publish(Float64MultiArray(data=[float("nan")] * len(peer.names)))

    def nothing():
        pass

    extra = ["finger_joint", *reversed(peer.names)]
    count = len(peer.names)
    peer.wait_until_ready(send)
    found = {"normal": peer.scenario(send), "permuted": peer.scenario(send, names=extra)}
    bad = {
        "missing": {"names": peer.names[:-1]},
        "nan": {"position": [float("nan")] * count},
        "no velocity": {"velocity": []},
        "stale": {"age": 0.5},
        "silent": {"silent": True},
    }
    for name, states in bad.items():
        found[name] = peer.scenario(send, **states)
        found[f"after {name}"] = peer.scenario(send)
    found["nan command"] = peer.scenario(send_nan)
    found["silent policy"] = peer.scenario(nothing)
    other = rclpy.create_node("teleoperation")
    other.create_publisher(Float64MultiArray, SAFE, 10)
    found["second publisher"] = peer.scenario(send)
    other.destroy_node()
    found["after second publisher"] = peer.scenario(send, seconds=2.0 * SCENARIO_SECONDS)
    found["markers"] = peer.markers
    return found


def trajectory(peer):
    """A trajectory to `command` [rad] beside the home posture, in one second."""
    publisher = peer.node.create_publisher(JointTrajectory, COMMANDS, 10)
    peer.wait_until_ready(lambda: None)
    goal = [q + d for q, d in zip(peer.job["home"], peer.job["command"], strict=True)]
    point = JointTrajectoryPoint(positions=goal, velocities=[0.0] * len(goal), time_from_start=Duration(sec=1))
    publisher.publish(JointTrajectory(joint_names=peer.names, points=[point]))
    found = {"trajectory": peer.scenario(lambda: None, seconds=3.0)}
    return found | {"q": peer.q, "goal": goal}


def twist(peer):
    """A twist of the tool along z, under a simulated clock."""
    publisher = peer.node.create_publisher(TwistStamped, COMMANDS, 10)
    message = TwistStamped()
    message.header.frame_id = "base"
    message.twist.linear.z = 0.05
    peer.wait_until_ready(lambda: publisher.publish(message))
    return {"twist": peer.scenario(lambda: publisher.publish(message), seconds=1.5)}


def rate(peer):
    """Time from publishing a joint state until the safe command has arrived, for states at a fixed rate."""
    publisher = peer.node.create_publisher(Float64MultiArray, COMMANDS, 10)
    command = Float64MultiArray(data=peer.job["command"])
    period, latencies, sent = 1.0 / peer.job["rate"], [], 0
    peer.wait_until_ready(lambda: publisher.publish(command))
    end, due = time.perf_counter() + peer.job["seconds"], time.perf_counter()
    while time.perf_counter() < end:
        due = max(due + period, time.perf_counter())
        publisher.publish(command)
        seen, begin = peer.received, time.perf_counter()
        peer.publish_states()
        sent += 1
        while (left := due - time.perf_counter()) > 0.0:
            rclpy.spin_once(peer.node, timeout_sec=left)
            if peer.received > seen and len(latencies) < sent:
                latencies.append(peer.received_at - begin)
                seen = 10**9
        latencies += [None] * (sent - len(latencies))  # no answer within the period
        peer.q = [q + period * v for q, v in zip(peer.q, peer.v, strict=True)]
    return {"sent": sent, "latencies": latencies}


def main():
    """Run the job."""
    job = json.loads(sys.argv[1])
    rclpy.init()
    peer = Peer(job)
    found = {"inputs": inputs, "trajectory": trajectory, "twist": twist, "rate": rate}[job["do"]](peer)
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()
