"""Joint drives of the plant with the same torque limits: computed torque, velocity actuators, or position servos.

Computed torque (feedback linearisation; Siciliano et al., Robotics, 8.5.2) demands v̇ = k (u − v); an integral term
compensates an unknown load:

    τ = M(q) k (u − v) + c(q, v) − p(q, v) + i,    i ← clip(i + M(q) κ/dt (w − v)),    w ← w + k dt (u − w)

with M the inertia including the rotors, c the Coriolis and gravity torque, p the passive torque (gravity compensation,
damping), each at the present state, and w the velocity of an undisturbed joint. Without disturbance w = v, so i stays
zero and v follows u exactly with a first-order lag of 1/k − dt (the last term because the plant is stepped
semi-implicitly). A load or a contact force makes v fall behind w, and i grows until it balances the load. The error
w − v then has two poles of modulus r = √(1 − k dt) per period; κ gives them a damping ratio of 1/√2:

    κ = 2 − k dt − 2 r cos(ln r)

The integral is bounded by a share of the motor's torque limit, and w is reset to v for a joint whose motor saturates,
so that the integral does not wind up.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from math import cos, log, sqrt
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.simulation.plant.position_servo import PositionServoDrive

Array = NDArray[np.float64]
DriveKind = Literal["computed_torque", "velocity", "position"]
DRIVE_KINDS: tuple[DriveKind, ...] = ("velocity", "computed_torque", "position")
ARM_ACTUATOR_GROUP = 1
"""Group of the actuators that are the joints' motors."""

TORQUE_LAG = 0.002
"""Velocity lag of the computed-torque drive [s]; its gain is k = 1/(TORQUE_LAG + dt) = 333 1/s."""
MAX_LOAD_SHARE = 0.5
"""Share of each motor's torque limit that the integral may use; the rest is reserved for motion and braking."""


class VelocityDrive:
    """The model's own velocity actuators, τ = kv (u − v), within the torque limits; it has no internal state."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Use the motors of `model` unchanged."""
        self._ctrl = data.ctrl[motor_slices(model)[0]]

    def apply(self, u: Array) -> None:
        """Send u (n,) [rad/s] to the actuators."""
        self._ctrl[:] = u

    def reset(self) -> None:
        """Command a velocity of zero."""
        self._ctrl[:] = 0.0


class ComputedTorqueDrive:
    """Feedback linearisation with an integral term for loads; the equations are in the docstring of this module."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Turn the velocity actuators of `model` into torque motors with the same torque limits."""
        motors, joints = motor_slices(model)
        model.actuator_gainprm[motors], model.actuator_biasprm[motors] = 0.0, 0.0
        model.actuator_gainprm[motors, 0] = 1.0
        self._model, self._data, self._joints = model, data, joints
        self._v, self._ctrl = data.qvel[joints], data.ctrl[motors]
        self._bias, self._passive = data.qfrc_bias[joints], data.qfrc_passive[joints]
        period = float(model.opt.timestep)
        self.gain = 1.0 / (TORQUE_LAG + period)
        self._gain_dt = self.gain * period
        self._integral_gain = _kappa(self._gain_dt) / period
        self._torque_limit = model.actuator_forcerange[motors, 1].copy()
        self._max_load = MAX_LOAD_SHARE * self._torque_limit
        self._min_load = -self._max_load
        self._saturated = np.zeros(len(self._v), bool)
        self._acceleration_buffer, self._force_buffer = np.zeros(model.nv), np.zeros(model.nv)
        self._expected = np.zeros(len(self._v))
        self.load = np.zeros(len(self._v))
        """The integral term i, shape (n,) [Nm]."""
        self._base_torque: Array | None = None

    def apply(self, u: Array) -> None:
        """Set the torques of this step for u (n,) [rad/s]; the motors clip them."""
        v, load = self._v, self.load
        if np.count_nonzero(self._saturated):
            np.copyto(self._expected, v, where=self._saturated)
        load += self._inertia_times(self._integral_gain * (self._expected - v))
        np.minimum(np.maximum(load, self._min_load, out=load), self._max_load, out=load)
        self._ctrl[:] = self._inertia_times(self.gain * (u - v)) + (self._bias - self._passive + load)
        if self._base_torque is not None:
            self._ctrl[:] += self._base_torque
        self._saturated = np.abs(self._ctrl) >= self._torque_limit
        self._expected += self._gain_dt * (u - self._expected)

    def reset(self) -> None:
        """Set torque and integral to zero, and the expected velocity w to the present velocity."""
        self._ctrl[:], self.load[:] = 0.0, 0.0
        self._expected[:], self._saturated[:] = self._v, False

    def set_base_acceleration(self, dofs: slice, acceleration: Array) -> None:
        """Feed forward the `acceleration` of the base in its degrees of freedom `dofs` for the next `apply`."""
        self._acceleration_buffer[:], self._acceleration_buffer[dofs] = 0.0, acceleration
        mujoco.mj_mulM(self._model, self._data, self._force_buffer, self._acceleration_buffer)
        self._acceleration_buffer[:] = 0.0
        self._base_torque = self._force_buffer[self._joints].copy()

    def _inertia_times(self, acceleration: Array) -> Array:
        """M times a joint acceleration (n,) [rad/s²]; the returned view is overwritten by the next call."""
        self._acceleration_buffer[self._joints] = acceleration
        mujoco.mj_mulM(self._model, self._data, self._force_buffer, self._acceleration_buffer)
        return self._force_buffer[self._joints]


def _kappa(share: float) -> float:
    """κ for k dt = `share`: the share of w − v that the integral takes up each period, for a damping ratio of 1/√2."""
    r = sqrt(1.0 - share)
    return 2.0 - share - 2.0 * r * cos(log(r))


def make_drive(
    kind: str, model: mujoco.MjModel, data: mujoco.MjData
) -> ComputedTorqueDrive | VelocityDrive | PositionServoDrive:
    """The drive called `kind` for the motors of `model`.

    Raises `UnknownNameError` for an unknown kind and `ConfigurationError` for motors of another form (`motor_slices`).
    """
    name = parse_drive_kind(kind)
    if name == "position":
        return PositionServoDrive(model, data, *motor_slices(model))
    return (ComputedTorqueDrive if name == "computed_torque" else VelocityDrive)(model, data)


def parse_drive_kind(name: str) -> DriveKind:
    """Check the name of a drive; raises `UnknownNameError`."""
    known: dict[str, DriveKind] = {kind: kind for kind in DRIVE_KINDS}
    if name not in known:
        raise UnknownNameError("drive", name, DRIVE_KINDS)
    return known[name]


def motor_slices(model: mujoco.MjModel) -> tuple[slice, slice]:
    """Index ranges of the motors (actuators of group 1) in `ctrl`, and of their joints in `qvel`.

    Raises `ConfigurationError` unless each motor drives one joint directly, with a torque limit, in the joints' order.
    """
    motors = np.flatnonzero(model.actuator_group == ARM_ACTUATOR_GROUP)
    joints = model.jnt_dofadr[model.actuator_trnid[motors, 0]]
    direct = np.all(model.actuator_trntype[motors] == int(mujoco.mjtTrn.mjTRN_JOINT))
    plain = direct and np.all(model.actuator_gear[motors, 0] == 1.0) and np.all(model.actuator_forcelimited[motors])
    ordered = len(motors) > 0 and np.all(np.diff(motors) == 1) and np.all(np.diff(joints) == 1)
    if not (plain and ordered):
        raise ConfigurationError(
            "motors of the robot model",
            got=f"actuators {motors.tolist()} on dofs {joints.tolist()}",
            allowed=f"group {ARM_ACTUATOR_GROUP}, one actuator per joint in the joints' order, gear 1, with forcerange",
        )
    return slice(int(motors[0]), int(motors[-1]) + 1), slice(int(joints[0]), int(joints[-1]) + 1)
