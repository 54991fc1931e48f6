"""The simulated base: a plant that drives, behind the same `Robot` protocol.

Its control is u = (v, ω), its configuration q = (x, y, θ). The wheels' own controller (`wheels.py`) follows u; the
planar joints are then driven at (v cos θ, v sin θ, ω), so that the axle never moves sideways.
Without its drive the base is held by friction brakes.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from math import cos, sin

import mujoco
import numpy as np

from dualbrain.robots.interface import Array, Command, RobotState
from dualbrain.simulation.models.mujoco_model import BASE_JOINTS
from dualbrain.simulation.plant.joint_drive import ARM_GROUP, DriveKind
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.plant.wheel_drive import Wheels
from dualbrain.simulation.scenes.scene_builder import PREFIX

BRAKES = (600.0, 600.0, 100.0)
"""Holding friction along x and y [N] and about z [Nm]."""


class BasePlant(Plant):
    """A MuJoCo room that a differential base drives in."""

    def _arrange(self, drive: DriveKind, load: float) -> None:
        del drive, load
        joints = [self.model.joint(f"{PREFIX}{name}") for name in BASE_JOINTS]
        self._arm = slice(int(joints[0].qposadr[0]), int(joints[-1].qposadr[0]) + 1)
        self._dof = slice(int(joints[0].dofadr[0]), int(joints[-1].dofadr[0]) + 1)
        first = int(self.model.actuator(f"{PREFIX}{BASE_JOINTS[0]}").id)
        self._motors = slice(first, first + len(BASE_JOINTS))
        self._wheels = Wheels(self.body)
        self._index_mover()
        self.place_arm(np.array(self.body.home))

    def read(self) -> RobotState:
        """The newest state: pose (x, y, θ) and velocity (v, ω) as measured."""
        self._sequence += 1
        return RobotState(
            self.data.time, self._sequence, self.data.qpos[self._arm].copy(), self.speed(), 0.0, (0.0, 0.0),
            self._enabled,
        )  # fmt: skip

    def speed(self) -> Array:
        """True (v, ω) [m/s, rad/s], v along the base's own x axis."""
        heading = float(self.data.qpos[self._arm][2])
        vx, vy, turn = self.data.qvel[self._dof].tolist()
        return np.array([vx * cos(heading) + vy * sin(heading), turn])

    def write(self, command: Command) -> None:
        """Hold `command` until the next one; ignored while the drive is disabled."""
        if self._enabled:
            self._u[:] = command.u

    def stop(self) -> None:
        """Cut the motors and engage the brakes until `enable`."""
        self._enabled = False
        self._forget()
        self.model.opt.disableactuator |= 1 << ARM_GROUP
        self.model.dof_frictionloss[self._dof] = BRAKES

    def enable(self) -> None:
        """Release the brakes with a velocity command of zero."""
        self._enabled = True
        self._forget()
        self.model.opt.disableactuator &= ~(1 << ARM_GROUP)
        self.model.dof_frictionloss[self._dof] = 0.0

    def act(self) -> None:
        """Wheels and mover get their set points, then time passes by one step; after `sense`."""
        heading, (v, w) = float(self.data.qpos[self._arm][2]), self._wheels.follow(self._u).tolist()
        self.data.ctrl[self._motors] = (v * cos(heading), v * sin(heading), w)
        self._move_mover()
        mujoco.mj_step2(self.model, self.data)

    def place_arm(self, q: Array, opening: float | None = None) -> None:
        """Put the base at `q` = (x, y, θ) at rest (set-up and tests only)."""
        del opening
        self.data.qpos[self._arm], self.data.qvel[self._dof] = q, 0.0
        mujoco.mj_forward(self.model, self.data)
        self._forget()

    def parts(self) -> dict[str, str]:
        """The base is one part."""
        return {self.body.links[0].name: f"{PREFIX}link0"}

    def _forget(self) -> None:
        self._u[:] = 0.0
        self._wheels.forget()
