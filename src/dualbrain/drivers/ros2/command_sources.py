"""Sources of commands, one per `command_type`: the last message, and the action of the guard that it asks for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dualbrain.drivers.ros2.joint_order import JointOrder
from dualbrain.drivers.ros2.parameters import NodeParameters
from dualbrain.drivers.ros2.trajectory import Trajectory, TrajectoryMessage, read_trajectory
from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.integration.policy_guard.action_space import ActionSpace
from dualbrain.safety.integration.policy_guard.joint_actions import JointVelocity
from dualbrain.safety.integration.policy_guard.tool_actions import ToolTwist

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TwistMessage:
    """A `geometry_msgs/TwistStamped`: linear [m/s] and angular velocity [rad/s] in the axes of `frame`."""

    linear: Sequence[float]
    angular: Sequence[float]
    frame: str


class CommandSource(Protocol):
    """The commands of one type."""

    @property
    def space(self) -> ActionSpace:
        """The action space of the guard."""
        ...

    @property
    def size(self) -> int:
        """Number of values of an action."""
        ...

    @property
    def may_be_silent(self) -> bool:
        """Whether one message is a complete motion, so that silence after it is no fault."""
        ...

    def receive(self, message: Any, q: Array, now: float) -> str:
        """Take `message` at joint positions q (n,) and `now` [s] on the clock of ROS; returns why it is unusable."""
        ...

    def action(self, q: Array, now: float) -> Array | str | None:
        """The action at q (n,) and `now` [s]; None without a command, or why the command ends."""
        ...

    def cancel(self) -> None:
        """Forget the command."""
        ...


class VelocitySource:
    """Joint velocities [rad/s] in the order of the controller, as `JointGroupVelocityController` takes them."""

    may_be_silent = False

    def __init__(self, order: JointOrder) -> None:
        """Begin without a command."""
        self.space: ActionSpace = JointVelocity()
        self.size = len(order.names)
        self._order = order
        self._velocity: Array | None = None

    def receive(self, message: Sequence[float], q: Array, now: float) -> str:
        """Take the data of a `Float64MultiArray`."""
        del q, now
        if problem := _problem_of("The command", message, self.size, f"in the order {', '.join(self._order.names)}"):
            return problem
        self._velocity = self._order.to_robot(message)
        return ""

    def action(self, q: Array, now: float) -> Array | str | None:
        """The last velocities."""
        del q, now
        return self._velocity

    def cancel(self) -> None:
        """Forget the command."""
        self._velocity = None


class TrajectorySource:
    """Trajectories: u_nom = v_d + k (q_d − q) follows the sampled position q_d with its velocity v_d."""

    may_be_silent = True

    def __init__(self, order: JointOrder, gain: float, tolerance: float) -> None:
        """Follow with `gain` k [1/s], at most `tolerance` [rad] beside the trajectory."""
        self.space: ActionSpace = JointVelocity()
        self.size = len(order.names)
        self._order, self._gain, self._tolerance = order, gain, tolerance
        self._trajectory: Trajectory | None = None

    def receive(self, message: TrajectoryMessage, q: Array, now: float) -> str:
        """Replace the trajectory; one without points ends the motion."""
        self._trajectory = None
        if not message.points:
            return ""
        found = read_trajectory(message, self._order, q, now)
        if isinstance(found, str):
            return found
        self._trajectory = found
        return ""

    def action(self, q: Array, now: float) -> Array | str | None:
        """The velocity toward the sampled position; after the last point the arm stays there."""
        if self._trajectory is None:
            return None
        position, velocity = self._trajectory.sample(now)
        error = position - q
        worst = int(np.argmax(np.abs(error)))
        if abs(error[worst]) > self._tolerance:
            self._trajectory = None
            return (
                f"{self._order.names_of_robot[worst]} is {abs(error[worst]):.2f} rad beside its trajectory, allowed "
                f"are {self._tolerance:g}; the trajectory is cancelled. Remedy: plan a new one from the present posture"
            )
        return velocity + self._gain * error

    def cancel(self) -> None:
        """Forget the trajectory."""
        self._trajectory = None


class TwistSource:
    """Twists of the tool in the axes of the base frame or of the tool frame, as MoveIt Servo takes them."""

    may_be_silent = False
    size = 6

    def __init__(self, safety: SafetyFilter, base_frame: str, tool_frame: str) -> None:
        """Accept twists in `base_frame` or `tool_frame`; raises `ConfigurationError` without any of them."""
        if not base_frame and not tool_frame:
            raise ConfigurationError.stating(
                "Commands of type twist need the name of their frame.",
                fix="Set the parameter `base_frame` or `tool_frame` to the frame_id of the commands.",
            )
        self.space: ActionSpace = ToolTwist()
        self._safety, self._base, self._tool = safety, base_frame, tool_frame
        self._twist: Array | None = None
        self._in_tool_frame = False

    def receive(self, message: TwistMessage, q: Array, now: float) -> str:
        """Take a twist."""
        del q, now
        if not message.frame or message.frame not in (self._base, self._tool):
            names = " or ".join(repr(name) for name in (self._base, self._tool) if name)
            return f"The twist has the frame_id {message.frame[:60]!r}. Remedy: send it in the frame {names}"
        twist = [*message.linear, *message.angular]
        if problem := _problem_of("The twist", twist, self.size, "linear, then angular"):
            return problem
        self._twist, self._in_tool_frame = np.asarray(twist, float), message.frame == self._tool
        return ""

    def action(self, q: Array, now: float) -> Array | str | None:
        """The last twist in the axes of the base."""
        del now
        if self._twist is None or not self._in_tool_frame:
            return self._twist
        rotation = self._safety.tool(q).rotation
        return np.concatenate([rotation @ self._twist[:3], rotation @ self._twist[3:]])

    def cancel(self) -> None:
        """Forget the twist."""
        self._twist = None


def make_source(parameters: NodeParameters, order: JointOrder, safety: SafetyFilter) -> CommandSource:
    """The source of the commands that `parameters` name; raises `ConfigurationError` if a parameter is missing."""
    if parameters.command_type == "trajectory":
        return TrajectorySource(order, parameters.trajectory_gain, parameters.path_tolerance)
    if parameters.command_type == "twist":
        return TwistSource(safety, parameters.base_frame, parameters.tool_frame)
    return VelocitySource(order)


def _problem_of(name: str, values: Sequence[float], count: int, order: str) -> str:
    """Why `values` are not `count` finite numbers, with a remedy, or ""."""
    if len(values) != count:
        return f"{name} has {len(values)} values. Remedy: send {count} values, {order}"
    finite = np.isfinite(values)
    if not finite.all():
        return f"Value {int(np.flatnonzero(~finite)[0])} of {name.lower()} is not finite. Remedy: check its source"
    return ""
