"""A UR controller without an arm: the names of `ur-rtde`; script, watchdog and safety system by the maker's manuals.

`speedJ` is taken only while the control script runs; it turns the joints with the given acceleration of the leading
axis and goes on until something else is said. A watchdog that is not kicked in time ends the script; so does a
protective stop, which can be unlocked only after 5 s, at the pendant. A joint beyond its speed limit is a protective
stop. Without a script the controller brakes the arm and holds it. Time passes only when a state is waited for.
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
BRAKING_ACCELERATION = 10.0
"""[rad/s²] with which the controller stops the joints."""
UNLOCK_DELAY = 5.0
MAX_ACCELERATION = 40.0


class FakeUrController:
    """The control box: script, watchdog, safety system."""

    def __init__(
        self, robot_model: RobotModel, limits: VendorLimits = UR5E, pace: Callable[[float], None] | None = None
    ) -> None:
        """Powered on, brakes released, in remote control."""
        self.arm, self.limits = FakeArm(robot_model.home, BRAKING_ACCELERATION, pace), limits
        self.script_running, self.protective_stopped, self.emergency_stopped = False, False, False
        self.watchdog_timeout, self.last_kick = inf, 0.0
        self._stopped_at = -inf
        self._u = self._goal = np.zeros(robot_model.n)
        self._acceleration = 0.0

    def load_script(self) -> bool:
        """Start the script, if the safety system lets it."""
        if self.protective_stopped or self.emergency_stopped:
            return False
        self.script_running, self.watchdog_timeout = True, inf
        self._u = self._goal = np.zeros_like(self._u)
        return True

    def end_script(self) -> None:
        """The script is over."""
        self.script_running = False

    def set_speed(self, qd: list[float], acceleration: float) -> bool:
        """Where the speed goes; False without a script."""
        if not 0.0 <= acceleration <= MAX_ACCELERATION:
            raise ValueError(f"acceleration {acceleration} is not within [0, {MAX_ACCELERATION}]")
        if self.script_running:
            self._goal, self._acceleration = np.array(qd), acceleration
        return self.script_running

    def trigger_protective_stop(self) -> None:
        """A protective stop."""
        self.protective_stopped, self.script_running, self._stopped_at = True, False, self.arm.now

    def press_emergency_stop(self) -> None:
        """The emergency stop: power goes, brakes engage."""
        self.emergency_stopped, self.script_running = True, False

    def release_emergency_stop(self) -> None:
        """Released, powered on again, brakes off: all of it at the pendant."""
        self.emergency_stopped = False

    def unlock_protective_stop(self) -> str:
        """What the dashboard answers to `unlock protective stop`."""
        if self.arm.now - self._stopped_at < UNLOCK_DELAY:
            return "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop"
        self.protective_stopped = False
        return "Protective stop releasing"

    def step(self) -> None:
        """One period of 2 ms."""
        if self.script_running and self.arm.now - self.last_kick > self.watchdog_timeout:
            self.script_running = False
        if not self.script_running:
            self.arm.follow(None, DT)
            self._u = self.arm.v.copy()
            return
        change = self._goal - self._u
        leading = float(np.abs(change).max())
        self._u = self._u + change * (min(1.0, self._acceleration * DT / leading) if leading > 0.0 else 0.0)
        self.arm.follow(self._u, DT)
        least, most = self.limits.velocity_limits(self.arm.q)
        low, high = self.limits.position_range.T
        beyond = (self.arm.v < least) | (self.arm.v > most) | (self.arm.q < low) | (self.arm.q > high)
        if beyond.any() or not np.isfinite(self._u).all():
            self.trigger_protective_stop()


class FakeUr:
    """Stands where `rtde_control` and `rtde_receive` would; `controller` is what the test may press and ask."""

    def __init__(self, robot_model: RobotModel, pace: Callable[[float], None] | None = None) -> None:
        """An arm of that body."""
        self.controller = FakeUrController(robot_model, pace=pace)

    def RTDEControlInterface(self, hostname: str, frequency: float = -1.0) -> Control:
        """Connect: the script is loaded."""
        del hostname, frequency
        if not self.controller.load_script():
            raise RuntimeError("Failed to start control script, before timeout of 5 seconds")
        return Control(self.controller)

    def RTDEReceiveInterface(self, hostname: str, frequency: float = -1.0) -> Receive:
        """Connect for reading."""
        del hostname, frequency
        return Receive(self.controller)


class Control:
    """`rtde_control.RTDEControlInterface`, as far as joint speeds need it."""

    def __init__(self, controller: FakeUrController) -> None:
        """Of that control box."""
        self._controller = controller

    def speedJ(self, qd: list[float], acceleration: float = 0.5, time: float = 0.0) -> bool:
        """Accelerate linearly in joint space and go on at that speed."""
        del time
        return self._controller.set_speed(qd, acceleration)

    def setWatchdog(self, min_frequency: float = 10.0) -> bool:
        """From now on a kick must come that often."""
        if self._controller.script_running:
            self._controller.watchdog_timeout, self._controller.last_kick = (
                1.0 / min_frequency,
                self._controller.arm.now,
            )
        return self._controller.script_running

    def kickWatchdog(self) -> bool:
        """We are alive."""
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
        """Hang up; the script ends."""
        self._controller.end_script()


class Receive:
    """`rtde_receive.RTDEReceiveInterface`, as far as joint states need it."""

    def __init__(self, controller: FakeUrController) -> None:
        """Of that control box."""
        self._controller = controller

    def initPeriod(self) -> timedelta:
        """The time at which a period begins."""
        return timedelta(seconds=self._controller.arm.now)

    def waitPeriod(self, arg0: timedelta) -> None:
        """Until the period that began then is over."""
        del arg0
        self._controller.step()

    def getTimestamp(self) -> float:
        """[s] since the controller was started."""
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
