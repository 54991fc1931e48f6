"""A UR arm of the e-series through `ur-rtde`: joint speeds (`speedJ`) at 500 Hz, under the controller's own watchdog.

`ur-rtde` runs a script on the controller. Stopping that script is the stop: the controller brakes the arm and holds it;
through this interface nothing engages the brakes. A protective or emergency stop is cleared at the pendant, never here.
"""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from threading import Thread
from typing import Any

import numpy as np

from dualbrain.drivers.driver import is_finite
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.robots.interface import Command, RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.safety.supervisor.timing import UR, Timing

FREQUENCY = 500.0
WATCHDOG_TIMEOUT = 0.1
"""No kick for this long [s]: the controller ends the script, and with it the motion."""
ACCELERATION_FACTOR = 1.5
"""`speedJ` accelerates by so much more than the body's own limit, so that no command is stretched on the way."""
MAX_ACCELERATION = 40.0
"""[rad/s²] is the most that `speedJ` takes."""
MAX_WAIT_PERIODS = 3
"""Periods that `wait` waits for a state with a new time stamp."""


class UrSdk:
    """The two halves of `ur-rtde` that are needed; raises `MissingPart` where it is not installed."""

    def __init__(self) -> None:
        """Import them."""
        try:
            self.RTDEControlInterface: Any = import_module("rtde_control").RTDEControlInterface
            self.RTDEReceiveInterface: Any = import_module("rtde_receive").RTDEReceiveInterface
        except ImportError as error:
            raise MissingDependencyError("ur-rtde", fix="Install it with `pip install 'dualbrain[ur]'`.") from error


class UrDriver:
    """One arm. Its gripper is not driven through `ur-rtde`: the fingers count as open, and no grasp succeeds."""

    timing: Timing = UR
    watchdog: float = WATCHDOG_TIMEOUT

    def __init__(self, sdk: Any, address: str, robot_model: RobotModel) -> None:
        """Connect and read once; nothing moves, the drive is off. Raises `InvalidSetup` if the arm cannot be had."""
        try:
            self._receive = sdk.RTDEReceiveInterface(address, FREQUENCY)
            self._control = sdk.RTDEControlInterface(address, FREQUENCY)
        except RuntimeError as error:
            raise ConfigurationError(
                "UR arm", got=str(error), allowed="one that answers, powered on and in remote control", fix=address
            ) from error
        if len(self._receive.getActualQ()) != robot_model.n:
            raise ConfigurationError(
                "body for a UR arm", got=f"{robot_model.name}: {robot_model.n} joints", allowed="6 joints"
            )
        self._opening = float(robot_model.gripper.opening.value)
        self._acceleration = min(
            MAX_ACCELERATION, ACCELERATION_FACTOR * max(joint.acceleration.value for joint in robot_model.joints)
        )
        self._is_enabled, self._closed = False, False
        self._start_thread: Thread | None = None
        self._faults: tuple[str, ...] = ()
        self._state = self._read_state()
        self._control.stopScript()

    # --- the robot protocol -------------------------------------------------------------------------------------

    def read(self) -> RobotState:
        """The newest state; opening as if open, no finger forces."""
        return self._state

    def write(self, command: Command) -> None:
        """Send joint speeds, and say that we are alive."""
        if not self._is_enabled:
            return
        if not is_finite(command):
            self._end_script("a command that is not finite")
            return
        try:
            taken = self._control.speedJ(command.u.tolist(), self._acceleration, 0.0) and self._control.kickWatchdog()
        except (RuntimeError, ValueError) as error:
            self._end_script(str(error))
            return
        if not taken:
            self._end_script(self._safety_stop() or "the controller does not take a joint speed: its script has ended")

    def stop(self) -> None:
        """End the script: the controller brakes the arm and holds it."""
        self._end_script()

    def enable(self) -> None:
        """Load the script again, which takes about a second, on a thread of its own: states go on meanwhile."""
        if self._is_enabled or self._closed or (self._start_thread and self._start_thread.is_alive()):
            return
        if stopped := self._safety_stop():
            self._faults = (f"{stopped}: clear it at the pendant",)
            return
        self._start_thread = Thread(target=self._start_script, name="ur script", daemon=True)
        self._start_thread.start()

    # --- the driver contract ------------------------------------------------------------------------------------

    def wait(self) -> None:
        """Until a state with a new time stamp, at most `PATIENCE` periods."""
        before = self._receive.getTimestamp()
        for _ in range(MAX_WAIT_PERIODS):
            self._receive.waitPeriod(self._receive.initPeriod())
            if self._receive.getTimestamp() != before:
                break
        self._state = self._read_state()
        if self._is_enabled and not self._state.drive_enabled:
            self._end_script(
                self._safety_stop() or "the controller's script has ended: its watchdog was not kicked in time"
            )

    def faults(self) -> tuple[str, ...]:
        """Which stop the controller is in, or why its script ended."""
        return self._faults

    def close(self) -> None:
        """Stop, and hang up."""
        self._end_script()
        if not self._closed:
            self._closed = True
            self._control.disconnect()

    # --- inside -------------------------------------------------------------------------------------------------

    def _start_script(self) -> None:
        try:
            ready = self._control.isProgramRunning() or self._control.reuploadScript()
            self._is_enabled = bool(ready and self._control.setWatchdog(1.0 / WATCHDOG_TIMEOUT))
            self._faults = () if self._is_enabled else ("the controller does not run the script",)
        except RuntimeError as error:
            self._faults = (str(error),)

    def _end_script(self, why: str = "") -> None:
        was, self._is_enabled = self._is_enabled, False
        if why:
            self._faults = (why,)
        if was:
            try:
                self._control.stopScript()
            except RuntimeError as error:
                self._faults = (*self._faults, str(error))
        self._state = replace(self._state, drive_enabled=False)

    def _safety_stop(self) -> str:
        if self._receive.isEmergencyStopped():
            return "emergency stop"
        return "protective stop" if self._receive.isProtectiveStopped() else ""

    def _read_state(self) -> RobotState:
        """One state, not parts of two: the library's own thread may bring the next while we read."""
        tries = 0
        while True:
            stamp, tries = self._receive.getTimestamp(), tries + 1
            q, v = self._receive.getActualQ(), self._receive.getActualQd()
            if self._receive.getTimestamp() == stamp or tries == MAX_WAIT_PERIODS:
                break
        driving = self._is_enabled and self._control.isProgramRunning() and not self._safety_stop()
        return RobotState(
            stamp=float(stamp),
            sequence=round(stamp * FREQUENCY),
            q=np.array(q),
            v=np.array(v),
            opening=self._opening,
            finger_forces=(0.0, 0.0),
            drive_enabled=driving,
        )
