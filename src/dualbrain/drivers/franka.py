"""Driver of a Franka Research 3 with the manufacturer's library (`pylibfranka`): joint velocities at 1 kHz.

The controller of the arm aborts a motion that violates a limit of velocity, acceleration (`velocity_discontinuity`) or
jerk (`acceleration_discontinuity`), or that misses 20 packets in a row; the driver then reports a fault and a disabled
drive. The driver changes no command, so the filter must limit the jerk (`FilterConfig(jerk_limits=True)`). The arm
continues a lost packet at constant acceleration; the states report it (`desired_v`, `desired_a`), and the next command
continues it.

A stop through this interface ends the motion, and the controller brakes the arm; only the user stop of the arm engages
the brakes. Panda arms (system version 4) use an older protocol, which this library does not support.
"""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from typing import Any, Literal

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
FOLLOWING_STATES = 5
"""States in a row that must confirm received commands before the arm counts as following."""
MAX_START_STATES = 200
"""States [1 ms each] within which an arm must follow after the start of a motion."""

Realtime = Literal["enforce", "ignore"]
"""What to do on a kernel without PREEMPT_RT: refuse it, or connect in spite of it."""


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

    def __init__(
        self, sdk: Any, address: str, robot_model: RobotModel, *, hand: bool = True, realtime: Realtime = "enforce"
    ) -> None:
        """Connect and read the first state; the drive stays off and nothing moves.

        With `realtime` "enforce" the manufacturer's library refuses a kernel without PREEMPT_RT. With "ignore" it
        connects from any kernel, for simulators and tests: packets can be late, and the arm may then abort a motion.

        Raises:
            ConfigurationError: The robot model does not have 7 joints, `realtime` is neither of the two, the kernel is
                not a real-time kernel, or the arm cannot be connected.
        """
        if realtime not in ("enforce", "ignore"):
            raise ConfigurationError("realtime of the Franka driver", got=realtime, allowed="'enforce' or 'ignore'")
        self._sdk, self._sdk_errors = sdk, tuple(getattr(sdk, name) for name in SDK_EXCEPTIONS)
        if robot_model.n != len(sdk.JointVelocities([0.0] * 7).dq):
            raise ConfigurationError(f"joints of {robot_model.name} on a Franka arm", got=robot_model.n, allowed="7")
        try:
            config = sdk.RealtimeConfig
            self._robot = sdk.Robot(address, config.kEnforce if realtime == "enforce" else config.kIgnore)
            gripper = sdk.Gripper(address) if hand else None
            raw = self._robot.read_once()
        except sdk.RealtimeException as error:
            raise ConfigurationError.stating(
                f"The manufacturer's library refuses this computer for the Franka arm at {address}: {error}.",
                fix="Run a kernel with PREEMPT_RT and allow real-time priorities. For a simulator or a test without a "
                "person near the arm, set realtime='ignore' (FrankaDriver) or `--realtime ignore` (command line).",
            ) from error
        except self._sdk_errors as error:
            raise ConfigurationError.stating(
                f"The Franka arm at {address} cannot be connected: {error}.",
                fix="Check the address, unlock the joints and activate FCI.",
            ) from error
        self._hand = FrankaHand(gripper, self._sdk_errors) if gripper is not None else None
        self._n_joints = robot_model.n
        self._control: Any = None
        self._faults: tuple[str, ...] = ()
        self._state = self._to_state(raw)

    # --- the robot interface ------------------------------------------------------------------------------------

    def read(self) -> RobotState:
        """The newest state; the finger forces are the commanded force while an object is held, else 0.

        Without a hand, and after an error of the hand, the opening is unknown.
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
        """Clear a reflex, start a motion, and send zeros until the arm reports that it follows.

        The arm follows when it is in motion mode and has confirmed received commands in `FOLLOWING_STATES` states in a
        row. The first control of the caller then continues a velocity of zero that the arm has already executed. No
        states arrive meanwhile (`drive_on_silence`). If the arm does not follow within `MAX_START_STATES` states, the
        motion ends with a fault.
        """
        if self._control is not None:
            return
        if self._hand:
            self._hand.clear_fault()
        try:
            if self._raw.current_errors or self._raw.robot_mode == self._sdk.RobotMode.Reflex:
                self._robot.automatic_error_recovery()
            self._control = self._robot.start_joint_velocity_control(self._sdk.ControllerMode.JointImpedance)
        except self._sdk_errors as error:
            self._faults = (str(error),)
        else:
            self._faults = ()
            self._send_zeros()

    # --- the driver interface -----------------------------------------------------------------------------------

    def wait(self) -> None:
        """Wait for the next state; an exception of the library, also for the hand, ends the motion."""
        try:
            raw = self._control.readOnce()[0] if self._control is not None else self._robot.read_once()
        except self._sdk_errors as error:
            self._record_abort(error)
            return
        hand_fault = self._hand.fault if self._hand else ""  # before the opening is read, which is then unknown
        self._state = self._to_state(raw)
        if self._control is not None and hand_fault:
            self._end_motion(hand_fault)

    def faults(self) -> tuple[str, ...]:
        """The message of the controller when it aborted the motion, or the error of the hand that ended it."""
        return self._faults

    def close(self) -> None:
        """Stop the arm; the fingers stay at their position."""
        self._end_motion()
        if self._hand:
            self._hand.close()

    @property
    def success_rate(self) -> float:
        """Share of the last 100 commands that the arm received in time, as it reports it; 0 without a motion."""
        return float(self._raw.control_command_success_rate)

    # --- private ------------------------------------------------------------------------------------------------

    def _send_zeros(self) -> None:
        """Answer every state with velocity zero until the arm follows."""
        zeros, confirmed = self._sdk.JointVelocities([0.0] * len(self._state.q)), 0
        try:
            for _ in range(MAX_START_STATES):
                raw = self._control.readOnce()[0]
                self._state = self._to_state(raw)
                confirmed = confirmed + 1 if self._follows(raw) else 0
                self._control.writeOnce(zeros)
                if confirmed >= FOLLOWING_STATES:
                    return
        except self._sdk_errors as error:
            self._record_abort(error)
        else:
            self._end_motion(f"the arm did not follow within {MAX_START_STATES} states after the start of a motion")

    def _follows(self, raw: Any) -> bool:
        """Whether a state shows a motion whose commands arrive; the rate is 0 without received commands."""
        return raw.robot_mode == self._sdk.RobotMode.Move and raw.control_command_success_rate > 0.0

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
            desired_v=np.array(raw.dq_d),
            desired_a=np.array(raw.ddq_d),
        )
