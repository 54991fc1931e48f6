"""Robot interface of the local control layer: read a state, write a command, stop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.model import RobotModel

Array = NDArray[np.float64]
COMMAND_TOLERANCE = 1e-6
"""Largest difference [rad/s] between a control and the reported command that is due to rounding."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotState:
    """Joint state at `stamp` [s]: q [rad] and v [rad/s] of shape (n,), finger opening [m each], finger forces [N].

    `opening` is None if the hardware does not report it; the filter then covers every opening. Without a measurement
    the finger forces are 0, so that no grasp counts as made.

    `torques` (n,) [Nm] are the mean motor torques since the state before, 0 for the joints of a mobile base. `wrench`
    (6,) is the mean force [N] and torque [Nm] that the arm exerts on the last chain frame, in its axes and about its
    origin. Both are None where the robot does not measure them (`RobotModel.force_sensing`).

    `desired_v` (n,) [rad/s] and `desired_a` (n,) [rad/s²] are the command that the robot executes, also where it
    continued a lost one by itself; None where the robot does not report them.
    """

    stamp: float
    sequence: int
    q: Array
    v: Array
    opening: float | None
    finger_forces: tuple[float, float]
    drive_enabled: bool = True
    torques: Array | None = None
    wrench: Array | None = None
    desired_v: Array | None = None
    desired_a: Array | None = None

    def executes(self, u: Array) -> bool:
        """Whether the command that the robot reports is the control u (n,) [rad/s]; True if it reports none."""
        return self.desired_v is None or float(np.abs(self.desired_v - u).max()) <= COMMAND_TOLERANCE


@dataclass(frozen=True, slots=True)
class Command:
    """Joint velocity u [rad/s] of shape (n,), target finger opening [m each] and grip force limit [N]."""

    u: Array
    opening: float
    force: float


class RobotInterface(Protocol):
    """A driver or a simulated plant. A command stays in effect until the next `write` or `stop`."""

    def read(self) -> RobotState:
        """The newest measured state."""
        ...

    def write(self, command: Command) -> None:
        """Apply `command` from now on; ignored while the drive is disabled (`read().drive_enabled` is False)."""
        ...

    def stop(self) -> None:
        """Disable the drive (stop category 0): the brakes engage and stay engaged until `enable` is called."""
        ...

    def enable(self) -> None:
        """Release the brakes with a velocity command of zero; only the supervisor decides when to call this."""
        ...


def home_state(robot_model: RobotModel) -> RobotState:
    """The state of `robot_model` at rest in its home posture with open fingers, at time 0."""
    return RobotState(
        stamp=0.0,
        sequence=0,
        q=np.array(robot_model.home),
        v=np.zeros(robot_model.n),
        opening=robot_model.gripper.opening.value,
        finger_forces=(0.0, 0.0),
    )
