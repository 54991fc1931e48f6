"""Driver of a Franka Research 3 with the manufacturer's library (`pylibfranka`): joint velocities at 1 kHz.

The controller of the arm aborts a motion that violates a limit of velocity, acceleration (`velocity_discontinuity`) or
jerk (`acceleration_discontinuity`), or that misses 20 packets in a row; the driver then reports a fault and a disabled
drive. The driver changes no command, so the filter must limit the jerk (`FilterConfig(jerk_limits=True)`).

A stop through this interface ends the motion, and the controller brakes the arm; only the user stop of the arm engages
the brakes. Panda arms (system version 4) use an older protocol, which this library does not support.
"""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np

from dualbrain.drivers.driver import command_fault
from dualbrain.drivers.franka_hand import FrankaHand
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.robots.interface import Command, RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.safety.supervisor.timing import FRANKA, Timing

SDK_EXCEPTIONS = (
    "FrankaException",
    "ControlException",
    "CommandException",
    "NetworkException",
    "InvalidOperationException",
    "RealtimeException",
)
"""All exceptions of the library, which have no common base class in Python."""
CYCLE_TIME = 1e-3
"""Period of the states [s]."""


def import_franka_sdk() -> Any:
    """The manufacturer's library; raises `MissingDependencyError` if it is not installed."""
    try:
        return import_module("pylibfranka")
    except ImportError as error:
        raise MissingDependencyError("pylibfranka", fix="Install it with `pip install 'dualbrain[franka]'`.") from error


class FrankaDriver:
    """Driver of one Franka Research 3 with its hand."""

    timing: Timing = FRANKA
    watchdog: float = 0.02
    """The arm stops by itself after 20 missed packets of 1 ms."""

    def __init__(self, sdk: Any, address: str, robot_model: RobotModel, *, hand: bool = True) -> None:
        """Connect and read the first state; the drive stays off and nothing moves.

        Raises:
            ConfigurationError: The robot model does not have 7 joints, or the arm cannot be connected.
        """
        self._sdk, self._sdk_errors = sdk, tuple(getattr(sdk, name) for name in SDK_EXCEPTIONS)
        if robot_model.n != len(sdk.JointVelocities([0.0] * 7).dq):
            raise ConfigurationError(f"joints of {robot_model.name} on a Franka arm", got=robot_model.n, allowed="7")
        try:
            self._robot = sdk.Robot(address, sdk.RealtimeConfig.kEnforce)
            gripper = sdk.Gripper(address) if hand else None
            raw = self._robot.read_once()
        except self._sdk_errors as error:
            raise ConfigurationError.stating(
                f"The Franka arm at {address} cannot be connected: {error}.",
                fix="Check the address, unlock the joints and activate FCI.",
            ) from error
        self._hand = (
            FrankaHand(gripper, self._sdk_errors, robot_model.gripper.opening.value) if gripper is not None else None
        )
        self._n_joints = robot_model.n
        self._control: Any = None
        self._faults: tuple[str, ...] = ()
        self._state = self._to_state(raw)

    # --- the robot interface ------------------------------------------------------------------------------------

    def read(self) -> RobotState:
        """The newest state; the finger forces are the commanded force while an object is held, else 0.

        Without a hand the opening is unknown.
        """
        return self._state

    def write(self, command: Command) -> None:
        """Send the joint velocity for this period, and the target of the hand."""
        if self._control is None:
            return
        if fault := command_fault(command, self._n_joints):
            self._end_motion(fault)
            return
        try:
            self._control.writeOnce(self._sdk.JointVelocities(command.u.tolist()))
        except self._sdk_errors as error:
            self._record_abort(error)
        if self._hand:
            self._hand.set_target(command.opening, command.force)

    def stop(self) -> None:
        """End the motion: the controller brakes the arm and holds it."""
        self._end_motion()

    def enable(self) -> None:
        """Clear a reflex and start a motion at velocity zero; no states arrive meanwhile (`drive_on_silence`)."""
        if self._control is not None:
            return
        try:
            if self._raw.current_errors or self._raw.robot_mode == self._sdk.RobotMode.Reflex:
                self._robot.automatic_error_recovery()
            self._control = self._robot.start_joint_velocity_control(self._sdk.ControllerMode.JointImpedance)
        except self._sdk_errors as error:
            self._faults = (str(error),)
        else:
            self._faults = ()

    # --- the driver interface -----------------------------------------------------------------------------------

    def wait(self) -> None:
        """Wait for the next state; an exception of the library ends the motion."""
        try:
            raw = self._control.readOnce()[0] if self._control is not None else self._robot.read_once()
        except self._sdk_errors as error:
            self._record_abort(error)
            return
        self._state = self._to_state(raw)

    def faults(self) -> tuple[str, ...]:
        """The message of the controller when it aborted the motion."""
        return self._faults

    def close(self) -> None:
        """Stop the arm; the fingers stay at their position."""
        self._end_motion()
        if self._hand:
            self._hand.close()

    # --- private ------------------------------------------------------------------------------------------------

    def _end_motion(self, fault: str = "") -> None:
        control, self._control = self._control, None
        if fault:
            self._faults = (fault,)
        if control is not None:
            try:
                self._robot.stop()
            except self._sdk_errors as error:
                self._faults = (str(error),)
        self._state = replace(self._state, drive_enabled=False)

    def _record_abort(self, error: Exception) -> None:
        """Record an aborted motion; the first fault is kept, because later ones are its consequences."""
        self._control, self._faults = None, self._faults or (str(error),)
        self._state = replace(self._state, drive_enabled=False)

    def _to_state(self, raw: Any) -> RobotState:
        self._raw = raw
        stamp = float(raw.time.to_sec())
        opening, force = self._hand.measured if self._hand else (None, 0.0)
        drive_enabled = self._control is not None and not raw.current_errors
        return RobotState(
            stamp=stamp,
            sequence=round(stamp / CYCLE_TIME),
            q=np.array(raw.q),
            v=np.array(raw.dq),
            opening=opening,
            finger_forces=(force, force),
            drive_enabled=drive_enabled,
        )
