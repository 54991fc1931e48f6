"""A Franka Research 3 through the maker's own library (`pylibfranka`): joint velocities at 1 kHz.

The arm's controller aborts a motion that breaks a limit of velocity, acceleration (`velocity_discontinuity`) or jerk
(`acceleration_discontinuity`), or that misses 20 packets in a row; each becomes `faults()` and a drive that is off. Its
jerk limits have to stand in the filter (`FilterConfig(jerk_limits=True)`): nothing here changes a command.

Through this interface a stop ends the motion and the controller brakes the arm; only the arm's own user stop engages
the brakes. Panda arms (system 4) speak an older protocol that this library does not.
"""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np

from dualbrain.drivers.driver import is_finite
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
"""All that the library raises; in Python they have no common root of their own."""
CYCLE_TIME = 1e-3


def import_franka_sdk() -> Any:
    """The maker's library; raises `MissingPart` where it is not installed."""
    try:
        return import_module("pylibfranka")
    except ImportError as error:
        raise MissingDependencyError("pylibfranka", fix="Install it with `pip install 'dualbrain[franka]'`.") from error


class FrankaDriver:
    """One arm with its hand."""

    timing: Timing = FRANKA
    watchdog: float = 0.02
    """20 packets of 1 ms missed in a row, and the arm stops by itself."""

    def __init__(self, sdk: Any, address: str, robot_model: RobotModel, *, hand: bool = True) -> None:
        """Connect and read once; nothing moves, the drive is off. Raises `InvalidSetup` if the arm cannot be had."""
        self._sdk, self._sdk_errors = sdk, tuple(getattr(sdk, name) for name in SDK_EXCEPTIONS)
        if robot_model.n != len(sdk.JointVelocities([0.0] * 7).dq):
            raise ConfigurationError(
                "body for a Franka arm", got=f"{robot_model.name}: {robot_model.n} joints", allowed="7 joints"
            )
        try:
            self._robot = sdk.Robot(address, sdk.RealtimeConfig.kEnforce)
            gripper = sdk.Gripper(address) if hand else None
            raw = self._robot.read_once()
        except self._sdk_errors as error:
            raise ConfigurationError(
                "Franka arm", got=str(error), allowed="one that answers, unlocked and with FCI active", fix=address
            ) from error
        self._hand = (
            FrankaHand(gripper, self._sdk_errors, robot_model.gripper.opening.value) if gripper is not None else None
        )
        self._opening = float(robot_model.gripper.opening.value)
        self._control: Any = None
        self._faults: tuple[str, ...] = ()
        self._state = self._to_state(raw)

    # --- the robot protocol -------------------------------------------------------------------------------------

    def read(self) -> RobotState:
        """The newest state; how firmly the fingers press is not measured, only whether they hold something."""
        return self._state

    def write(self, command: Command) -> None:
        """Send a joint velocity for this period, and the hand where to go."""
        if self._control is None:
            return
        if not is_finite(command):
            self._end_motion("a command that is not finite")
            return
        try:
            self._control.writeOnce(self._sdk.JointVelocities(command.u.tolist()))
        except self._sdk_errors as error:
            self._record_abort(error)
        if self._hand:
            self._hand.set_target(command.opening, command.force)

    def stop(self) -> None:
        """End the motion: the arm's controller brakes, and holds the arm."""
        self._end_motion()

    def enable(self) -> None:
        """Clear a reflex and begin a motion at velocity zero; the arm is silent meanwhile (`Timing.quiet`)."""
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

    # --- the driver contract ------------------------------------------------------------------------------------

    def wait(self) -> None:
        """Until the next state; what the library raises ends the motion."""
        try:
            raw = self._control.readOnce()[0] if self._control is not None else self._robot.read_once()
        except self._sdk_errors as error:
            self._record_abort(error)
            return
        self._state = self._to_state(raw)

    def faults(self) -> tuple[str, ...]:
        """What the controller said when it aborted the motion."""
        return self._faults

    def close(self) -> None:
        """Stop the arm and leave the hand as it is."""
        self._end_motion()
        if self._hand:
            self._hand.close()

    # --- inside -------------------------------------------------------------------------------------------------

    def _end_motion(self, why: str = "") -> None:
        control, self._control = self._control, None
        if why:
            self._faults = (why,)
        if control is not None:
            try:
                self._robot.stop()
            except self._sdk_errors as error:
                self._faults = (str(error),)
        self._state = replace(self._state, drive_enabled=False)

    def _record_abort(self, error: Exception) -> None:
        """What is said first stays said; what follows from it says less."""
        self._control, self._faults = None, self._faults or (str(error),)
        self._state = replace(self._state, drive_enabled=False)

    def _to_state(self, raw: Any) -> RobotState:
        self._raw = raw
        stamp = float(raw.time.to_sec())
        opening, force = self._hand.measured if self._hand else (self._opening, 0.0)
        driving = self._control is not None and not raw.current_errors
        return RobotState(
            stamp=stamp,
            sequence=round(stamp / CYCLE_TIME),
            q=np.array(raw.q),
            v=np.array(raw.dq),
            opening=opening,
            finger_forces=(force, force),
            drive_enabled=driving,
        )
