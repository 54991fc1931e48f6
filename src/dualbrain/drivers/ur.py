"""Driver of a UR e-series arm with `ur-rtde`: joint speeds (`speedJ`) at 500 Hz and the watchdog of the controller.

`ur-rtde` runs a script on the controller. The driver stops the arm by ending that script: the controller brakes the arm
and holds it; the brakes cannot be engaged through this interface. A protective or emergency stop is cleared at the
pendant, never by the driver.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from importlib import import_module
from threading import Lock, Thread
from typing import Any

import numpy as np

from dualbrain.drivers.driver import command_fault
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.robots.interface import Command, RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.safety.supervisor.timing import UR, Timing

FREQUENCY = 500.0
"""Rate of the states [1/s]."""
WATCHDOG_TIMEOUT = 0.1
"""Time [s] without a watchdog kick after which the controller ends the script and the motion."""
ACCELERATION_FACTOR = 1.5
"""Acceleration of `speedJ` relative to the limit of the robot model; above 1, so that `speedJ` delays no command."""
MAX_ACCELERATION = 40.0
"""Largest acceleration that `speedJ` accepts [rad/s²]."""
MAX_START_TIME = 3.0
"""Maximum time [s] that `close` waits for the end of a switch-on."""
MAX_WAIT_PERIODS = 3
"""Maximum number of periods that `wait` waits for a state with a new time stamp."""

UNREADABLE = "the safety status cannot be read"
"""Beginning of the fault of a connection that does not give the safety stops of the controller."""


class UrSdk:
    """The control and receive interfaces of `ur-rtde`."""

    def __init__(self) -> None:
        """Import both interfaces; raises `MissingDependencyError` if `ur-rtde` is not installed."""
        try:
            self.RTDEControlInterface: Any = import_module("rtde_control").RTDEControlInterface
            self.RTDEReceiveInterface: Any = import_module("rtde_receive").RTDEReceiveInterface
        except ImportError as error:
            raise MissingDependencyError("ur-rtde", fix="Install it with `pip install 'dualbrain[ur]'`.") from error


class UrDriver:
    """Driver of one UR e-series arm without a gripper: the fingers are reported as open, and no grasp succeeds."""

    timing: Timing = UR
    watchdog: float = WATCHDOG_TIMEOUT

    def __init__(self, sdk: Any, address: str, robot_model: RobotModel) -> None:
        """Connect and read the first state; the drive stays off and nothing moves.

        Raises:
            ConfigurationError: The robot model does not have 6 joints, or the arm cannot be connected.
        """
        try:
            self._receive = sdk.RTDEReceiveInterface(address, FREQUENCY)
            self._control = sdk.RTDEControlInterface(address, FREQUENCY)
        except RuntimeError as error:
            raise ConfigurationError.stating(
                f"The UR arm at {address} cannot be connected: {error}.",
                fix="Check the address, power the arm on and switch to remote control.",
            ) from error
        if len(self._receive.getActualQ()) != robot_model.n:
            raise ConfigurationError(f"joints of {robot_model.name} on a UR arm", got=robot_model.n, allowed="6")
        self._n_joints = robot_model.n
        self._acceleration = min(
            MAX_ACCELERATION, ACCELERATION_FACTOR * max(joint.acceleration.value for joint in robot_model.joints)
        )
        self._is_enabled, self._closed = False, False
        self._lock = Lock()
        """Guards the three flags of the switch-on: `_is_enabled`, `_wanted` and `_is_starting`."""
        self._wanted, self._is_starting = False, False
        self._start_thread: Thread | None = None
        self._faults: tuple[str, ...] = ()
        self._state = self._read_state()
        self._control.stopScript()

    # --- the robot interface ------------------------------------------------------------------------------------

    def read(self) -> RobotState:
        """The newest state; the opening is unknown, and the finger forces are 0."""
        return self._state

    def write(self, command: Command) -> None:
        """Send joint speeds and kick the watchdog; an invalid command ends the script and kicks nothing."""
        if not self._is_enabled:
            return
        if fault := command_fault(command, self._n_joints):
            self._end_script(fault)
            return
        try:
            accepted = (
                self._control.speedJ(command.u.tolist(), self._acceleration, 0.0) and self._control.kickWatchdog()
            )
        except (RuntimeError, ValueError) as error:
            self._end_script(str(error))
            return
        if not accepted:
            self._end_script(self._safety_stop() or "the controller rejects joint speeds: its script has ended")

    def stop(self) -> None:
        """End the script: the controller brakes the arm and holds it."""
        self._end_script()

    def enable(self) -> None:
        """Load the script again in a separate thread; this takes about a second, in which states continue to arrive.

        A stop in this time ends the script as soon as it is loaded, and the drive stays off.
        """
        if self._is_enabled or self._closed:
            return
        if safety_stop := self._safety_stop():
            remedy = "check the connection" if safety_stop.startswith(UNREADABLE) else "clear it at the pendant"
            self._faults = (f"{safety_stop}: {remedy}",)
            return
        with self._lock:
            if self._is_enabled:  # since the first check
                return
            was_starting, self._wanted, self._is_starting = self._is_starting, True, True
        if not was_starting:
            self._start_thread = Thread(target=self._start_script, name="ur script", daemon=True)
            self._start_thread.start()

    # --- the driver interface -----------------------------------------------------------------------------------

    def wait(self) -> None:
        """Wait for a state with a new time stamp, for at most `MAX_WAIT_PERIODS` periods; an error ends the motion."""
        try:
            self._state = self._wait_for_state()
        except RuntimeError as error:
            self._end_script(f"the joint states cannot be read: {error}")
            return
        if self._is_enabled and not self._state.drive_enabled:
            self._end_script(
                self._safety_stop() or "the controller's script has ended: its watchdog was not kicked in time"
            )

    def faults(self) -> tuple[str, ...]:
        """The safety stop of the controller, or the reason why its script ended."""
        return self._faults

    def close(self) -> None:
        """Stop the arm and disconnect, after the end of a switch-on."""
        self._end_script()
        if not self._closed:
            self._closed = True
            if self._start_thread is not None:
                self._start_thread.join(MAX_START_TIME)
            for interface in (self._control, self._receive):
                with suppress(RuntimeError):  # of a connection that is lost already
                    interface.disconnect()

    # --- private ------------------------------------------------------------------------------------------------

    def _start_script(self) -> None:
        """Load the script, and end it again if the drive is no longer wanted; runs in a separate thread."""
        fault = self._load_script()
        with self._lock:
            self._is_starting, self._is_enabled = False, self._wanted and not fault
            if self._wanted:
                self._faults = (fault,) if fault else ()
            else:
                self._stop_script()

    def _load_script(self) -> str:
        """Load the script and set its watchdog; returns the fault, "" if the script runs."""
        try:
            ready = self._control.isProgramRunning() or self._control.reuploadScript()
            is_running = ready and self._control.setWatchdog(1.0 / WATCHDOG_TIMEOUT)
        except RuntimeError as error:
            return str(error)
        return "" if is_running else "the controller does not run the script"

    def _end_script(self, fault: str = "") -> None:
        with self._lock:
            was_enabled, self._is_enabled, self._wanted = self._is_enabled, False, False
        if fault:
            self._faults = (fault,)
        if was_enabled:
            self._stop_script()
        self._state = replace(self._state, drive_enabled=False)

    def _stop_script(self) -> None:
        try:
            self._control.stopScript()
        except RuntimeError as error:
            self._faults = (*self._faults, str(error))

    def _safety_stop(self) -> str:
        """The safety stop of the controller, or that it cannot be read; "" without one."""
        try:
            if self._receive.isEmergencyStopped():
                return "emergency stop"
            return "protective stop" if self._receive.isProtectiveStopped() else ""
        except RuntimeError as error:
            return f"{UNREADABLE} ({error})"

    def _wait_for_state(self) -> RobotState:
        """The state with the next time stamp, or the present one after `MAX_WAIT_PERIODS`; raises `RuntimeError`."""
        before = self._receive.getTimestamp()
        for _ in range(MAX_WAIT_PERIODS):
            self._receive.waitPeriod(self._receive.initPeriod())
            if self._receive.getTimestamp() != before:
                break
        return self._read_state()

    def _read_state(self) -> RobotState:
        """A consistent state: it is read again if the thread of the library replaced it in the meantime."""
        attempts = 0
        while True:
            stamp, attempts = self._receive.getTimestamp(), attempts + 1
            q, v = self._receive.getActualQ(), self._receive.getActualQd()
            if self._receive.getTimestamp() == stamp or attempts == MAX_WAIT_PERIODS:
                break
        drive_enabled = self._is_enabled and self._control.isProgramRunning() and not self._safety_stop()
        return RobotState(
            stamp=float(stamp),
            sequence=round(stamp * FREQUENCY),
            q=np.array(q),
            v=np.array(v),
            opening=None,
            finger_forces=(0.0, 0.0),
            drive_enabled=drive_enabled,
        )
