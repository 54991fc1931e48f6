"""How a joint velocity becomes motion in the plant: MuJoCo's velocity actuators, or computed torque on the same motors.

Computed torque (feedback linearisation; Siciliano et al., Robotics, 8.5.2) asks for v̇ = k (u − v):

    τ = M(q) k (u − v) + c(q, v) − g_c(q)

with M the inertia with the rotors', c the Coriolis and gravity torque and g_c what the model compensates itself, each
at the state of the moment, τ within the motors' torque. v follows u with a first-order lag of 1/k − dt: the last term
because the plant is stepped semi-implicitly.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import UnknownName
from dualbrain.world.plant import Plant
from dualbrain.world.scene_builder import PERIOD, PREFIX

Array = NDArray[np.float64]
DriveKind = Literal["velocity", "computed_torque"]
KINDS = ("velocity", "computed_torque")

TORQUE_LAG = 0.002
"""Lag that the computed torque is tuned to [s]; its gain is k = 1/(TORQUE_LAG + dt) = 333 1/s."""


class Drive:
    """A plant stepped in two halves: `sense()` makes everything current, `act(u)` drives for one control period.

    The fingers stay where they are. Contacts may be left out (`contacts=False`): nothing is touched in a loop that
    judges distances.
    """

    def __init__(self, plant: Plant, kind: DriveKind = "velocity", *, contacts: bool = True) -> None:
        """`kind` velocity: the plant's own actuators; computed_torque: motors with the same torque limits."""
        if kind not in KINDS:
            raise UnknownName("drive", kind, KINDS)
        self.plant, self.kind, self.gain = plant, kind, 1.0 / (TORQUE_LAG + PERIOD)
        model, n = plant.model, plant.body.n
        self._model, self._data = model, plant.data
        q, self._dof = plant.arm_slices
        self.q, self.v = plant.data.qpos[q], plant.data.qvel[self._dof]
        first = int(model.actuator(f"{PREFIX}actuator1").id)
        self._motors = slice(first, first + n)
        self._inertia = np.empty((model.nv, model.nv))
        self._arm_inertia = self._inertia[self._dof, self._dof]
        self._bias, self._compensated = plant.data.qfrc_bias[self._dof], plant.data.qfrc_gravcomp[self._dof]
        if kind == "computed_torque":
            model.actuator_gainprm[self._motors], model.actuator_biasprm[self._motors] = 0.0, 0.0
            model.actuator_gainprm[self._motors, 0] = 1.0
        if not contacts:
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)

    def sense(self) -> None:
        """Make poses, inertia and bias those of the state now; `q` and `v` (n,) are views of it."""
        mujoco.mj_step1(self._model, self._data)

    def act(self, u: Array) -> None:
        """Drive at joint velocity u (n,) [rad/s] for one control period."""
        if self.kind == "velocity":
            self._data.ctrl[self._motors] = u
        else:
            mujoco.mj_fullM(self._model, self._data, self._inertia)
            torque = self._arm_inertia @ (self.gain * (u - self.v)) + self._bias - self._compensated
            self._data.ctrl[self._motors] = torque
        mujoco.mj_step2(self._model, self._data)
