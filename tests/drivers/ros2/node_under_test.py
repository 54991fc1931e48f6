"""A Panda behind the node's core or the whole node: parameters, joint states and robot descriptions."""

from importlib import metadata
from pathlib import Path

import numpy as np

from dualbrain import HalfSpace, Obstacle
from dualbrain.core.geometry.shapes import Box, Pose
from dualbrain.drivers.ros2.assembly import make_command_filter
from dualbrain.drivers.ros2.joint_order import JointStates
from dualbrain.drivers.ros2.parameters import NodeParameters
from dualbrain.robots.loader import load_robot

PANDA = load_robot("panda")
NAMES = tuple(joint.name for joint in PANDA.joints)
HOME = np.array(PANDA.home)
PERIOD = 0.005
TABLE = Obstacle("table", HalfSpace(), Pose((0.0, 0.0, -0.05)), parts=("arm", "hand", "fingers"))
CRATE = Obstacle("crate", Box((0.1, 0.1, 0.3)), Pose((0.45, 0.42, 0.3)))


def panda_urdf():
    """The description of the Panda in example-robot-data."""
    folder = metadata.distribution("example-robot-data").locate_file("cmeel.prefix/share/example-robot-data/robots")
    return (Path(str(folder)) / "panda_description/urdf/panda.urdf").read_text("utf-8")


def urdf_of(robot_model, names=None, mount=(0.0, 0.0, 0.0)):
    """A URDF without shapes that has the joints of `robot_model`, with its base link `base` at `mount` in `world`."""
    names = names or [joint.name for joint in robot_model.joints]
    lines = ['<robot name="test"><link name="world"/><link name="base"/>', _joint("mount", "fixed", "world", mount)]
    parent = "base"
    for name, joint in zip(names, robot_model.joints, strict=True):
        kind = "prismatic" if joint.kind == "prismatic" else "revolute"
        limits = (joint.lower.value, joint.upper.value, joint.velocity.value)
        lines.append(f'<link name="{name}_link"/>')
        lines.append(_joint(name, kind, parent, joint.translation, joint.quaternion, limits))
        parent = f"{name}_link"
    return "\n".join([*lines, "</robot>"])


def _joint(name, kind, parent, translation, quaternion=(1.0, 0.0, 0.0, 0.0), limits=None):
    w, x, y, z = quaternion
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    child = "base" if name == "mount" else f"{name}_link"
    limit = "" if limits is None else '<limit lower="{}" upper="{}" velocity="{}" effort="1"/>'.format(*limits)
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><axis xyz="0 0 1"/>'
        f'<origin xyz="{" ".join(map(str, translation))}" rpy="{roll} {pitch} {yaw}"/>{limit}</joint>'
    )


def parameters(**changes):
    """Parameters of the node for the Panda, without a check of the description."""
    return NodeParameters(**({"check_description": "none", "period": PERIOD} | changes)).validate()


def make_core(obstacles=(TABLE, CRATE), **changes):
    """The core of the node."""
    return make_command_filter(parameters(**changes), obstacles)


class Cell:
    """The core of the node with an arm that follows its commands exactly, and a stepped clock."""

    def __init__(self, core=None, q=HOME, names=NAMES):
        self.core = core or make_core()
        self.names, self.now, self.q, self.v = names, 100.0, np.array(q), np.zeros(len(names))
        self.sent = []
        self.missed = 0.0

    def command(self, message):
        """Send a command now."""
        self.core.receive_command(message, self.now, self.now)

    def states(self, names=None, positions=None, velocities=None, stamp=None):
        """Publish joint states now, with the given entries instead of the true ones; returns the safe velocities."""
        states = JointStates(
            self.names if names is None else names,
            self.q.tolist() if positions is None else positions,
            self.v.tolist() if velocities is None else velocities,
            self.now if stamp is None else stamp,
        )
        return self.core.receive_states(states, self.now, self.now)

    def run(self, seconds, command=None, silent=False, **states):
        """Run a loop at the period of the filter; `silent` without joint states. Returns the last velocities."""
        for _ in range(round(seconds / PERIOD)):
            self.now += PERIOD
            if command is not None:
                self.command(command)
            sent = None if silent else self.states(**states)
            sent = self.core.idle(self.now) if sent is None else sent
            if sent is not None:
                self.v = np.array(sent)
                self.sent.append(self.v)
            self.q = self.q + PERIOD * self.v
        return self.v

    def diagnose(self):
        """The diagnosis since the last one."""
        return self.core.diagnose(self.now)
