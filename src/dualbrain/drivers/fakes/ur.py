"""Fake of a UR controller: the names of `ur-rtde`; script, watchdog and safety system as in the manuals.

`speedJ` is accepted only while the control script runs. It moves the joints with the given acceleration of the leading
axis, until the next command. A watchdog that is not kicked in time ends the script; so does a protective stop, which
can be unlocked only after 5 s and at the pendant. A joint that exceeds its speed limit causes a protective stop.
Without a script the controller brakes the arm and holds it. Time advances only when a state is requested.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import timedelta
from math import inf

import numpy as np

from dualbrain.drivers.fakes.arm import FakeArm
from dualbrain.drivers.vendor_limits import UR5E, VendorLimits
from dualbrain.robots.model import RobotModel

DT = 2e-3
"""Period of the controller [s]."""
BRAKING_ACCELERATION = 10.0
"""Deceleration with which the controller stops the joints [rad/s²]."""
UNLOCK_DELAY = 5.0
"""Time after a protective stop before which it cannot be unlocked [s]."""
MAX_ACCELERATION = 40.0
"""Largest acceleration that `speedJ` accepts [rad/s²]."""


class FakeUrController:
    """Fake of the control box: script, watchdog and safety system."""

    def __init__(
        self, robot_model: RobotModel, limits: VendorLimits = UR5E, pace: Callable[[float], None] | None = None
    ) -> None:
        """The arm is powered on in the home posture of `robot_model`, brakes released, in remote control."""
        self.arm, self.limits = FakeArm(robot_model.home, BRAKING_ACCELERATION, pace), limits
        self.script_running, self.protective_stopped, self.emergency_stopped = False, False, False
        self.connections = 0
        """Number of control and receive interfaces that are connected."""
        self.watchdog_timeout, self.last_kick = inf, 0.0
        self._stopped_at = -inf
        self._u = self._goal = np.zeros(robot_model.n)
        self._acceleration = 0.0

    def load_script(self) -> bool:
        """Start the script, unless the safety system has stopped the arm; whether it runs."""
        if self.protective_stopped or self.emergency_stopped:
            return False
        self.script_running, self.watchdog_timeout = True, inf
        self._u = self._goal = np.zeros_like(self._u)
        return True

    def end_script(self) -> None:
        """End the script."""
        self.script_running = False

    def set_speed(self, qd: list[float], acceleration: float) -> bool:
        """Set the target speed (6,) [rad/s] and the acceleration [rad/s²]; False if no script runs."""
        if not 0.0 <= acceleration <= MAX_ACCELERATION:
            raise ValueError(f"acceleration {acceleration} is not within [0, {MAX_ACCELERATION}]")
        if self.script_running:
            self._goal, self._acceleration = np.array(qd), acceleration
        return self.script_running

    def trigger_protective_stop(self) -> None:
        """Make the safety system stop the arm."""
        self.protective_stopped, self.script_running, self._stopped_at = True, False, self.arm.now

    def press_emergency_stop(self) -> None:
        """Press the emergency stop: the power is cut and the brakes engage."""
        self.emergency_stopped, self.script_running = True, False

    def release_emergency_stop(self) -> None:
        """Release the emergency stop, power on and release the brakes, as at the pendant."""
        self.emergency_stopped = False

    def unlock_protective_stop(self) -> str:
        """The answer of the dashboard server to `unlock protective stop`."""
        if self.arm.now - self._stopped_at < UNLOCK_DELAY:
            return "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop"
        self.protective_stopped = False
        return "Protective stop releasing"

    def step(self) -> None:
        """Advance the time by one period of 2 ms."""
        if self.script_running and self.arm.now - self.last_kick > self.watchdog_timeout:
            self.script_running = False
        if not self.script_running:
            self.arm.follow(None, DT)
            self._u = self.arm.v.copy()
            return
        change = self._goal - self._u
        largest_change = float(np.abs(change).max())
        share = min(1.0, self._acceleration * DT / largest_change) if largest_change > 0.0 else 0.0
        self._u = self._u + change * share
        self.arm.follow(self._u, DT)
        v_min, v_max = self.limits.velocity_limits(self.arm.q)
        low, high = self.limits.position_range.T
        outside = (self.arm.v < v_min) | (self.arm.v > v_max) | (self.arm.q < low) | (self.arm.q > high)
        if outside.any() or not np.isfinite(self._u).all():
            self.trigger_protective_stop()


class FakeUr:
    """Fake of `rtde_control` and `rtde_receive`; tests control and inspect the arm through `controller`."""

    def __init__(self, robot_model: RobotModel, pace: Callable[[float], None] | None = None) -> None:
        """A fake arm with the joints of `robot_model`; `pace(now)` may delay each step."""
        self.controller = FakeUrController(robot_model, pace=pace)

    def RTDEControlInterface(self, hostname: str, frequency: float = -1.0) -> Control:
        """Connect for control, which loads the script."""
        del hostname, frequency
        if not self.controller.load_script():
            raise RuntimeError("Failed to start control script, before timeout of 5 seconds")
        return Control(self.controller)

    def RTDEReceiveInterface(self, hostname: str, frequency: float = -1.0) -> Receive:
        """Connect for reading."""
        del hostname, frequency
        return Receive(self.controller)


class Control:
    """The part of `rtde_control.RTDEControlInterface` that joint speeds need."""

    def __init__(self, controller: FakeUrController) -> None:
        """The control interface of `controller`."""
        self._controller = controller
        controller.connections += 1

    def speedJ(self, qd: list[float], acceleration: float = 0.5, time: float = 0.0) -> bool:
        """Accelerate linearly in joint space and continue at that speed."""
        del time
        return self._controller.set_speed(qd, acceleration)

    def setWatchdog(self, min_frequency: float = 10.0) -> bool:
        """From now on, `kickWatchdog` must be called at this frequency [1/s]."""
        if self._controller.script_running:
            self._controller.watchdog_timeout, self._controller.last_kick = (
                1.0 / min_frequency,
                self._controller.arm.now,
            )
        return self._controller.script_running

    def kickWatchdog(self) -> bool:
        """Kick the watchdog."""
        self._controller.last_kick = self._controller.arm.now
        return self._controller.script_running

    def stopScript(self) -> None:
        """End the script."""
        self._controller.end_script()

    def reuploadScript(self) -> bool:
        """Load the script again."""
        return self._controller.load_script()

    def isProgramRunning(self) -> bool:
        """Whether the script runs."""
        return self._controller.script_running

    def disconnect(self) -> None:
        """Disconnect, which ends the script."""
        self._controller.connections -= 1
        self._controller.end_script()


class Receive:
    """The part of `rtde_receive.RTDEReceiveInterface` that joint states need."""

    def __init__(self, controller: FakeUrController) -> None:
        """The receive interface of `controller`."""
        self._controller = controller
        controller.connections += 1

    def initPeriod(self) -> timedelta:
        """The start time of a period."""
        return timedelta(seconds=self._controller.arm.now)

    def waitPeriod(self, arg0: timedelta) -> None:
        """Wait for the end of the period that started at `arg0`."""
        del arg0
        self._controller.step()

    def getTimestamp(self) -> float:
        """Time since the controller was started [s]."""
        return self._controller.arm.now

    def getActualQ(self) -> list[float]:
        """Joint positions [rad]."""
        return self._controller.arm.q.tolist()

    def getActualQd(self) -> list[float]:
        """Joint velocities [rad/s]."""
        return self._controller.arm.v.tolist()

    def isProtectiveStopped(self) -> bool:
        """Whether the safety system has stopped the arm."""
        return self._controller.protective_stopped

    def isEmergencyStopped(self) -> bool:
        """Whether the emergency stop is pressed."""
        return self._controller.emergency_stopped

    def disconnect(self) -> None:
        """Disconnect."""
        self._controller.connections -= 1
