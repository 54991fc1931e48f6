"""How a joint velocity becomes motion in the plant: computed torque, or MuJoCo's velocity actuators on the same motors.

Computed torque (feedback linearisation; Siciliano et al., Robotics, 8.5.2) asks for v̇ = k (u − v), to which an integral
adds what a load takes away:

    τ = M(q) k (u − v) + c(q, v) − p(q, v) + i,    i ← clip(i + M(q) κ/dt (w − v)),    w ← w + k dt (u − w)

with M the inertia with the rotors', c the Coriolis and gravity torque, p the passive torque (gravity compensation,
damping), each at the state of the moment, and w the velocity that an undisturbed joint would have now. Undisturbed,
w = v, so that i stays zero and v follows u exactly with a first-order lag of 1/k − dt (the last term because the plant
is stepped semi-implicitly). A load that is held or pressed against makes v fall behind w, and i grows until it bears
the load. The error w − v then has two poles of modulus r = √(1 − k dt) a period; κ puts them at damping 1/√2:

    κ = 2 − k dt − 2 r cos(ln r)

The integral is bounded by a share of the motor's torque, and a joint whose motor saturates is expected to go on as it
does (w = v), so that nothing winds up.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from math import cos, log, sqrt
from typing import Literal, Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError, UnknownNameError

Array = NDArray[np.float64]
DriveKind = Literal["computed_torque", "velocity"]
DRIVE_KINDS: tuple[DriveKind, ...] = ("velocity", "computed_torque")
ARM_ACTUATOR_GROUP = 1
"""Group of the actuators that are the joints' motors."""

TORQUE_LAG = 0.002
"""Lag that the computed torque is tuned to [s]; its gain is k = 1/(TORQUE_LAG + dt) = 333 1/s."""
MAX_LOAD_SHARE = 0.5
"""Share of each motor's torque that the integral may take; the rest is left to move and to brake."""


class Drive(Protocol):
    """What turns joint velocities into torques; called once a control period, when everything is current."""

    def apply(self, u: Array) -> None:
        """Set the motors for this period so that the joints go towards u (n,) [rad/s]."""
        ...

    def reset(self) -> None:
        """Forget what was: the arm is at another place, or was held by its brakes."""
        ...


class VelocityDrive:
    """The model's own velocity actuators, τ = kv (u − v), within the motors' torque; it has no memory."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """The motors of `model` as they are."""
        self._ctrl = data.ctrl[motor_slices(model)[0]]

    def apply(self, u: Array) -> None:
        """Hand u over."""
        self._ctrl[:] = u

    def reset(self) -> None:
        """No torque is wanted."""
        self._ctrl[:] = 0.0


class ComputedTorqueDrive:
    """Feedback linearisation with rejection of loads; the equations are above."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Turns the velocity actuators of `model` into motors with the same torque limits."""
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
        """What the integral bears now, (n,) [Nm]."""
        self._base_torque: Array | None = None

    def apply(self, u: Array) -> None:
        """Torques of this period; the motors clip them."""
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
        """No torque, no load; the joints are expected to go on as they do."""
        self._ctrl[:], self.load[:] = 0.0, 0.0
        self._expected[:], self._saturated[:] = self._v, False

    def set_base_acceleration(self, dofs: slice, acceleration: Array) -> None:
        """What bears the arm accelerates its own `dofs` like this in this period; the joints hold against it."""
        self._acceleration_buffer[:], self._acceleration_buffer[dofs] = 0.0, acceleration
        mujoco.mj_mulM(self._model, self._data, self._force_buffer, self._acceleration_buffer)
        self._acceleration_buffer[:] = 0.0
        self._base_torque = self._force_buffer[self._joints].copy()

    def _inertia_times(self, acceleration: Array) -> Array:
        """M times a joint acceleration (n,), as a view that the next call overwrites."""
        self._acceleration_buffer[self._joints] = acceleration
        mujoco.mj_mulM(self._model, self._data, self._force_buffer, self._acceleration_buffer)
        return self._force_buffer[self._joints]


def _kappa(share: float) -> float:
    """Share of w − v that the integral takes up each period, for damping 1/√2."""
    r = sqrt(1.0 - share)
    return 2.0 - share - 2.0 * r * cos(log(r))


def make_drive(kind: str, model: mujoco.MjModel, data: mujoco.MjData) -> ComputedTorqueDrive | VelocityDrive:
    """The drive called `kind` on the motors of `model`; raises `UnknownName` with the known ones."""
    return (ComputedTorqueDrive if parse_drive_kind(kind) == "computed_torque" else VelocityDrive)(model, data)


def parse_drive_kind(name: str) -> DriveKind:
    """The drive called `name`; raises `UnknownName` with the known ones."""
    known: dict[str, DriveKind] = {"computed_torque": "computed_torque", "velocity": "velocity"}
    if name not in known:
        raise UnknownNameError("drive", name, DRIVE_KINDS)
    return known[name]


def motor_slices(model: mujoco.MjModel) -> tuple[slice, slice]:
    """Where the motors (actuators of group 1) lie among the actuators, and their joints in qvel.

    Raises `InvalidSetup` unless each drives one joint of its own without a gear, within a torque limit, in their order.
    """
    motors = np.flatnonzero(model.actuator_group == ARM_ACTUATOR_GROUP)
    joints = model.jnt_dofadr[model.actuator_trnid[motors, 0]]
    direct = np.all(model.actuator_trntype[motors] == int(mujoco.mjtTrn.mjTRN_JOINT))
    plain = direct and np.all(model.actuator_gear[motors, 0] == 1.0) and np.all(model.actuator_forcelimited[motors])
    ordered = len(motors) > 0 and np.all(np.diff(motors) == 1) and np.all(np.diff(joints) == 1)
    if not (plain and ordered):
        raise ConfigurationError(
            "motors of the robot model",
            got=f"actuators {motors.tolist()} on joints' dofs {joints.tolist()}",
            allowed=f"actuators of group {ARM_ACTUATOR_GROUP}, one a joint in the joints' order, gear 1, with forcerange",
        )
    return slice(int(motors[0]), int(motors[-1]) + 1), slice(int(joints[0]), int(joints[-1]) + 1)
