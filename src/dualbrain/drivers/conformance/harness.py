"""Test harness of a driver: enables it, commands smooth motions in its own periods, and records all states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import pi, sin, sqrt
from time import sleep

import numpy as np
from numpy.typing import NDArray

from dualbrain.drivers.driver import Driver
from dualbrain.robots.interface import Command, RobotState
from dualbrain.robots.model import RobotModel

Array = NDArray[np.float64]

SMALL_MOTION = 0.03
"""Angle [rad] by which a joint is moved to check that it is the right joint."""
SMALL_MOTION_TIME = 0.6
"""Duration of a small motion [s]."""
LARGE_MOTION = 0.2
"""Maximum angle [rad] of a motion at the limits of the robot model."""
LIMIT_SHARE = 0.97
"""Share of the limits of the robot model that a motion at the limits uses."""
SETTLE_TIME = 0.1
"""Time [s] between the end of a motion and the check of the result."""
THREAD_YIELD_TIME = 1e-4
"""Time [s] given to the threads of the driver in each period while the drive is being enabled."""


@dataclass(frozen=True, slots=True)
class DriverUnderTest:
    """A newly connected driver whose arm is at rest in the home posture of the robot model.

    `trigger_stop` makes the safety system of the arm stop it, and `clear_stop` clears that stop; None if this cannot be
    done.
    """

    driver: Driver
    robot_model: RobotModel
    trigger_stop: Callable[[], None] | None = None
    clear_stop: Callable[[], None] | None = None


class DriverHarness:
    """Runs motions on a driver under test and records every state."""

    def __init__(self, under_test: DriverUnderTest) -> None:
        """Record the first state."""
        self.driver, self.robot_model, self.under_test = under_test.driver, under_test.robot_model, under_test
        self.n, self.period = under_test.robot_model.n, under_test.driver.timing.period
        self.states: list[RobotState] = [under_test.driver.read()]
        self.written: list[tuple[Array, RobotState]] = []
        """Every command (n,) [rad/s] with the state after its period."""

    @property
    def state(self) -> RobotState:
        """The newest state."""
        return self.states[-1]

    def make_command(self, u: Array) -> Command:
        """A command that leaves the fingers open."""
        gripper = self.robot_model.gripper
        return Command(u, float(gripper.opening.value), float(gripper.force_min.value))

    def wait(self, periods: int = 1) -> None:
        """Wait for `periods` states without writing a command."""
        for _ in range(periods):
            self.driver.wait()
            self.states.append(self.driver.read())

    def write(self, u: Array, periods: int = 1) -> None:
        """Write the joint velocity u (n,) [rad/s] once in each period."""
        for _ in range(periods):
            self.driver.write(self.make_command(u))
            self.wait()
            self.written.append((u, self.state))

    def n_periods(self, seconds: float) -> int:
        """Number of periods in `seconds` [s], at least 1."""
        return max(1, round(seconds / self.period))

    def switch_on(self) -> bool:
        """Enable the drive at velocity zero; whether it was enabled within `timing.drive_on_timeout`."""
        self.driver.enable()
        for _ in range(self.n_periods(self.driver.timing.drive_on_timeout)):
            self.write(np.zeros(self.n))
            if self.state.drive_enabled:
                return True
            sleep(THREAD_YIELD_TIME)
        return False

    def swing_joint(self, joint: int, peak: float, seconds: float, stop_fraction: float = 1.0) -> float:
        """Command v(t) = peak sin²(π t/T) on one joint, up to `stop_fraction` T; returns the commanded ∫v dt [rad]."""
        total, periods = 0.0, self.n_periods(seconds)
        for k in range(round(stop_fraction * periods)):
            u = np.zeros(self.n)
            u[joint] = peak * sin(pi * (k + 1) / periods) ** 2
            total += u[joint] * self.period
            self.write(u)
        return total

    def inward_sign(self, joint: int) -> float:
        """Sign of the direction in which the joint is farther from the end of its range."""
        bounds = self.robot_model.joints[joint]
        return 1.0 if bounds.upper.value - self.state.q[joint] > self.state.q[joint] - bounds.lower.value else -1.0

    def max_swing(self, joint: int) -> tuple[float, float]:
        """Peak [rad/s] and duration [s] of the sin² motion at `LIMIT_SHARE` of the limits, within `LARGE_MOTION`.

        v = p sin²(π t/T) has the maximum acceleration π p/T, the maximum jerk 2 π² p/T² and the travel p T/2.
        """
        bounds = self.robot_model.joints[joint]
        a = LIMIT_SHARE * bounds.acceleration.value
        peak = min(LIMIT_SHARE * bounds.velocity.value, sqrt(2.0 * LARGE_MOTION * a / pi))
        seconds = pi * peak / a
        if bounds.jerk is not None:
            seconds = max(seconds, pi * sqrt(2.0 * peak / (LIMIT_SHARE * bounds.jerk.value)))
        return peak, seconds

    def max_joint_speed(self) -> float:
        """Largest joint speed of the newest state [rad/s]."""
        return float(np.abs(self.state.v).max())
