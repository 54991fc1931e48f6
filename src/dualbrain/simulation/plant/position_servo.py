"""Joint drive of stock position servos: a proportional law on a commanded position, without feedforward.

    q_c ← q_c + u dt,      τ = k_p (q_c − q) − k_d v,      |τ| ≤ τ_max

The stiffness k_p = τ_max / `FULL_TORQUE_ERROR` gives the full torque at that error, and the damping is k_d = 2 ζ √(k_p
M_ii), with the inertia in the zero position. Nothing compensates gravity or a load: the joints stay behind their
command ("sag"), the more the heavier the arm is stretched, and at constant speed by k_d/k_p · u. The command stays
within `MAX_ERROR` of the joint, so that a blocked servo does not wind up.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FULL_TORQUE_ERROR = 0.1
"""Position error [rad] at which a servo gives its full torque."""
DAMPING_RATIO = 0.5
"""Damping ratio ζ of a joint at rest, alone."""
MAX_ERROR = 2.0 * FULL_TORQUE_ERROR
"""Largest distance [rad] between the commanded and the measured position."""


class PositionServoDrive:
    """Position servos whose command integrates the velocity control; the module has the equations."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, motors: slice, joints: slice) -> None:
        """Turn the actuators `motors` of `model` into torque motors on the degrees of freedom `joints`."""
        model.actuator_gainprm[motors], model.actuator_biasprm[motors] = 0.0, 0.0
        model.actuator_gainprm[motors, 0] = 1.0
        address = model.jnt_qposadr[model.dof_jntid[joints]]
        self._q, self._v = data.qpos[slice(int(address[0]), int(address[-1]) + 1)], data.qvel[joints]
        self._passive, self._ctrl = data.qfrc_gravcomp[joints], data.ctrl[motors]
        self._dt = float(model.opt.timestep)
        self._stiffness = model.actuator_forcerange[motors, 1] / FULL_TORQUE_ERROR
        self._damping = 2.0 * DAMPING_RATIO * np.sqrt(self._stiffness * _inertia(model, data)[joints])
        self.target: Array = self._q.copy()
        """The commanded position q_c (n,) [rad]."""

    def apply(self, u: Array) -> None:
        """Move the commanded position by u (n,) [rad/s] for one physics step, and set the torques of this step."""
        moved = self.target + self._dt * u
        self.target = np.clip(moved, self._q - MAX_ERROR, self._q + MAX_ERROR)
        torque = self._stiffness * (self.target - self._q) - self._damping * self._v
        self._ctrl[:] = torque - self._passive  # the simulated arm is balanced; a servo carries its weight itself

    def reset(self) -> None:
        """Command the measured position."""
        self._ctrl[:] = 0.0
        self.target = self._q.copy()


def _inertia(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """The diagonal of the inertia matrix at the configuration of `data`, rotors included."""
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return np.diag(full).copy()
