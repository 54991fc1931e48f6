"""Joints by their names: messages may list them in any order and with others; commands have the controller's order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.drivers.ros2.parameters import NodeParameters
from dualbrain.errors import ConfigurationError
from dualbrain.robots.model import RobotModel

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class JointStates:
    """A `sensor_msgs/JointState`: names, positions and velocities, and its stamp [s] on the clock of ROS."""

    names: Sequence[str]
    positions: Sequence[float]
    velocities: Sequence[float]
    stamp: float


class JointOrder:
    """The joints of the controller by their ROS names, and the place of each in the robot model."""

    def __init__(self, robot_model: RobotModel, parameters: NodeParameters) -> None:
        """Map the joints of `parameters` to those of `robot_model`.

        Raises:
            ConfigurationError: the names are not those of the robot model, each once.
        """
        known = tuple(joint.name for joint in robot_model.joints)
        in_model = parameters.robot_joints or parameters.joints or known
        names = parameters.joints or in_model
        if sorted(in_model) != sorted(known):
            fix = "Name the joints of the robot model in `robot_joints`, in the same order as `joints`."
            raise ConfigurationError("joints of the node", got=list(in_model), allowed=f"{list(known)}", fix=fix)
        if len(names) != len(in_model) or len(set(names)) != len(names):
            raise ConfigurationError("parameter joints", got=list(names), allowed=f"{len(known)} different names")
        self.names: tuple[str, ...] = tuple(names)
        """ROS names in the order of the controller."""
        self.names_of_robot: tuple[str, ...] = tuple(names[in_model.index(joint)] for joint in known)
        """ROS names in the order of the robot model."""
        self._to_robot = [names.index(name) for name in self.names_of_robot]
        self._to_controller = [self.names_of_robot.index(name) for name in names]

    def to_robot(self, values: Sequence[float]) -> Array:
        """`values` (n,) in the order of the controller as (n,) in the order of the robot model."""
        return np.asarray(values, float)[self._to_robot]

    def to_controller(self, values: Array) -> list[float]:
        """`values` (n,) in the order of the robot model as a list in the order of the controller."""
        return values[self._to_controller].tolist()

    def concerns(self, names: Sequence[str]) -> bool:
        """Whether a message about `names` has any of these joints: a gripper may publish on the same topic."""
        return not set(self.names).isdisjoint(names)

    def read_states(self, states: JointStates) -> tuple[Array, Array] | str:
        """Positions and velocities (n,) in the order of the robot model, or why the message is unusable."""
        indices = self._indices(states.names, "joint_states")
        if isinstance(indices, str):
            return indices
        count = len(states.names)
        if len(states.velocities) != count:
            return (
                f"joint_states has {len(states.velocities)} velocities for {count} joints. Remedy: give the hardware "
                "component velocity state interfaces, and let joint_state_broadcaster publish them"
            )
        if len(states.positions) != count:
            return (
                f"joint_states has {len(states.positions)} positions for {count} joints. Remedy: publish joint_states "
                "with joint_state_broadcaster"
            )
        q, v = (np.asarray(values, float)[indices] for values in (states.positions, states.velocities))
        for what, values in (("position", q), ("velocity", v)):
            if not np.isfinite(values).all():
                name = self.names_of_robot[int(np.flatnonzero(~np.isfinite(values))[0])]
                return f"The {what} of {name} in joint_states is not finite. Remedy: check the sensor of this joint"
        return q, v

    def read_named(self, names: Sequence[str], what: str) -> list[int] | str:
        """Index in `names` of every joint of the robot model, which must be all of `names`, or why it is not."""
        indices = self._indices(names, what)
        if not isinstance(indices, str) and (unknown := [name for name in names if name not in self.names]):
            return (
                f"{what} has the unknown joint {unknown[0][:60]!r}. Remedy: send the joints {', '.join(self.names)} "
                "only, or change the parameter `joints`"
            )
        return indices

    def _indices(self, names: Sequence[str], what: str) -> list[int] | str:
        places = {name: index for index, name in enumerate(names)}
        if missing := [name for name in self.names_of_robot if name not in places]:
            return (
                f"{what} lacks {', '.join(missing)}. Remedy: publish all joints in one message, or change the "
                "parameter `joints`"
            )
        if len(places) != len(names):
            twice = next(name for index, name in enumerate(names) if places[name] != index)
            return f"{what} names {twice[:60]} twice. Remedy: publish every joint once"
        return [places[name] for name in self.names_of_robot]
