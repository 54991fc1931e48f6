"""A driver under examination: it is switched on, moved smoothly, and watched; everything in its own periods."""

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
"""[rad] that a joint is moved to see that it is the right one."""
SMALL_MOTION_TIME = 0.6
LARGE_MOTION = 0.2
"""[rad] that joints are moved when they are driven as hard as the body may."""
LIMIT_SHARE = 0.97
"""Of the body's limits: what the hardest motion asks for."""
SETTLE_TIME = 0.1
"""[s] after which a motion that has been braked is looked at."""
THREAD_YIELD_TIME = 1e-4
"""[s] for which a driver's own threads are given room, in each period in which it is being switched on."""


@dataclass(frozen=True, slots=True)
class DriverUnderTest:
    """A fresh driver, connected, its arm at rest in the body's home posture; and what a person can do to its arm.

    `provoke` makes the maker's own safety stop the arm, `clear` undoes that; None where it cannot be done.
    """

    driver: Driver
    robot_model: RobotModel
    trigger_stop: Callable[[], None] | None = None
    clear_stop: Callable[[], None] | None = None


class DriverHarness:
    """Carries out motions on a subject and keeps every state that came."""

    def __init__(self, under_test: DriverUnderTest) -> None:
        """Nothing has happened yet."""
        self.driver, self.robot_model, self.under_test = under_test.driver, under_test.robot_model, under_test
        self.n, self.period = under_test.robot_model.n, under_test.driver.timing.period
        self.states: list[RobotState] = [under_test.driver.read()]

    @property
    def state(self) -> RobotState:
        """The newest state."""
        return self.states[-1]

    def make_command(self, u: Array) -> Command:
        """A command that leaves the fingers open."""
        grip = self.robot_model.gripper
        return Command(u, float(grip.opening.value), float(grip.force_min.value))

    def wait(self, periods: int = 1) -> None:
        """Let periods pass in which nothing is written."""
        for _ in range(periods):
            self.driver.wait()
            self.states.append(self.driver.read())

    def write(self, u: Array, periods: int = 1) -> None:
        """Write a joint velocity (n,) once in each period."""
        for _ in range(periods):
            self.driver.write(self.make_command(u))
            self.wait()

    def n_periods(self, seconds: float) -> int:
        """How many periods that is."""
        return max(1, round(seconds / self.period))

    def switch_on(self) -> bool:
        """Switch the drive on and stand; whether it came on in the time that the driver declares."""
        self.driver.enable()
        for _ in range(self.n_periods(self.driver.timing.drive_on_timeout)):
            self.write(np.zeros(self.n))
            if self.state.drive_enabled:
                return True
            sleep(THREAD_YIELD_TIME)
        return False

    def swing_joint(self, joint: int, peak: float, seconds: float, stop_fraction: float = 1.0) -> float:
        """Turn one joint with v(t) = peak sin²(π t/T), stop at `until` T; ∫v dt [rad] as it was asked for."""
        total, periods = 0.0, self.n_periods(seconds)
        for k in range(round(stop_fraction * periods)):
            u = np.zeros(self.n)
            u[joint] = peak * sin(pi * (k + 1) / periods) ** 2
            total += u[joint] * self.period
            self.write(u)
        return total

    def inward_sign(self, joint: int) -> float:
        """The sign of the direction in which a joint has more room."""
        bounds = self.robot_model.joints[joint]
        return 1.0 if bounds.upper.value - self.state.q[joint] > self.state.q[joint] - bounds.lower.value else -1.0

    def max_swing(self, joint: int) -> tuple[float, float]:
        """Peak [rad/s] and length [s] of the sin² that reaches `SHARE` of the body's limits within `FAR` rad.

        Of v = p sin²(π t/T): greatest acceleration π p/T, greatest jerk 2 π² p/T², travel p T/2.
        """
        bounds = self.robot_model.joints[joint]
        a = LIMIT_SHARE * bounds.acceleration.value
        peak = min(LIMIT_SHARE * bounds.velocity.value, sqrt(2.0 * LARGE_MOTION * a / pi))
        seconds = pi * peak / a
        if bounds.jerk is not None:
            seconds = max(seconds, pi * sqrt(2.0 * peak / (LIMIT_SHARE * bounds.jerk.value)))
        return peak, seconds

    def max_joint_speed(self) -> float:
        """The fastest joint now [rad/s]."""
        return float(np.abs(self.state.v).max())
