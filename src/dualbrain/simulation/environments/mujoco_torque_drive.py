"""Dynamics of an arm in a MuJoCo model of others, for the action space of joint torques.

    M v̇ = τ + p(q, v) − b(q, v)

with the inertia M of the arm's joints, which includes that of the rotors, the passive torque p (damping, springs, drag)
and the bias b (gravity, Coriolis). All three are those of the present state of the simulation. Contacts, and loads in
the hand, are unknown to it.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.simulation.environments.mujoco_arm import MujocoArm

Array = NDArray[np.float64]


class MujocoTorqueDrive:
    """Forward dynamics and computed torque of an arm, at the state that its simulation has (`TorqueDrive`)."""

    def __init__(self, arm: MujocoArm) -> None:
        """The drive of `arm`, whose simulation has computed its velocity-dependent terms (`mj_step1`)."""
        self._model, self._data, self._dofs = arm.model, arm.data, arm.dofs
        self._period = arm.robot_model.period
        self._column, self._unit = np.zeros(self._model.nv), np.zeros(self._model.nv)

    def acceleration(self, q: Array, v: Array, torque: Array) -> Array:
        """Joint accelerations (n,) [rad/s²] that `torque` (n,) [Nm] causes; q and v are those of the simulation."""
        del q, v
        return np.asarray(np.linalg.solve(self._inertia(), torque - self._load()), np.float64)

    def track(self, q: Array, v: Array, u: Array) -> Array:
        """The torque (n,) [Nm] that brings the joints from `v` to `u` (n,) [rad/s] within one period."""
        del q
        return self._inertia() @ ((u - v) / self._period) + self._load()

    def _load(self) -> Array:
        """The torque (n,) [Nm] at which the joints do not accelerate."""
        return self._data.qfrc_bias[self._dofs] - self._data.qfrc_passive[self._dofs]

    def _inertia(self) -> Array:
        """The inertia matrix (n, n) [kg m²] of the joints of the arm."""
        inertia = np.zeros((len(self._dofs), len(self._dofs)))
        for k, dof in enumerate(self._dofs):
            self._unit[:] = 0.0
            self._unit[dof] = 1.0
            mujoco.mj_mulM(self._model, self._data, self._column, self._unit)
            inertia[:, k] = self._column[self._dofs]
        return inertia
