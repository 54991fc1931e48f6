"""Simulated differential-drive base behind `RobotInterface`.

The control is u = (v, ω), the configuration q = (x, y, θ). The wheel controller (`wheel_drive.py`) follows u; the
planar joints are driven at (v cos θ, v sin θ, ω), so that the axle never moves sideways. While the drive is disabled,
friction brakes hold the base.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from math import cos, sin

import mujoco
import numpy as np

from dualbrain.robots.interface import Array, Command, RobotState
from dualbrain.simulation.models.mujoco_model import BASE_JOINT_NAMES
from dualbrain.simulation.plant.joint_drive import ARM_ACTUATOR_GROUP, DriveKind
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.plant.plant_state import PlantState
from dualbrain.simulation.plant.wheel_drive import WheelDrive
from dualbrain.simulation.scenes.scene_builder import ROBOT_PREFIX

BRAKE_FRICTION = (600.0, 600.0, 100.0)
"""Holding friction along x and y [N] and about z [Nm]."""


class MobileBasePlant(Plant):
    """A MuJoCo simulation of a differential-drive base in a room."""

    def _set_up(self, drive: DriveKind, load: float) -> None:
        del drive, load
        joints = [self.model.joint(f"{ROBOT_PREFIX}{name}") for name in BASE_JOINT_NAMES]
        self._arm = slice(int(joints[0].qposadr[0]), int(joints[-1].qposadr[0]) + 1)
        self._dof = slice(int(joints[0].dofadr[0]), int(joints[-1].dofadr[0]) + 1)
        first = int(self.model.actuator(f"{ROBOT_PREFIX}{BASE_JOINT_NAMES[0]}").id)
        self._motors = slice(first, first + len(BASE_JOINT_NAMES))
        self._wheel_drive = WheelDrive(self.robot_model)
        self._index_moving_person()
        self.set_configuration(np.array(self.robot_model.home))

    def read(self) -> RobotState:
        """The measured state: pose (x, y, θ) [m, rad] and velocity (v, ω) [m/s, rad/s]."""
        self._sequence += 1
        return RobotState(
            stamp=self.data.time,
            sequence=self._sequence,
            q=self.data.qpos[self._arm].copy(),
            v=self.robot_velocity(),
            opening=0.0,
            finger_forces=(0.0, 0.0),
            drive_enabled=self._enabled,
        )

    def robot_velocity(self) -> Array:
        """True (v, ω) [m/s, rad/s], v along the x axis of the base."""
        heading = float(self.data.qpos[self._arm][2])
        vx, vy, turn = self.data.qvel[self._dof].tolist()
        return np.array([vx * cos(heading) + vy * sin(heading), turn])

    def write(self, command: Command) -> None:
        """Apply `command` until the next one; ignored while the drive is disabled."""
        if self._enabled:
            self._u[:] = command.u

    def stop(self) -> None:
        """Disable the motors and engage the brakes until `enable`."""
        self._enabled = False
        self._reset_commands()
        self.model.opt.disableactuator |= 1 << ARM_ACTUATOR_GROUP
        self.model.dof_frictionloss[self._dof] = BRAKE_FRICTION

    def enable(self) -> None:
        """Release the brakes and enable the motors with a velocity command of zero."""
        self._enabled = True
        self._reset_commands()
        self.model.opt.disableactuator &= ~(1 << ARM_ACTUATOR_GROUP)
        self.model.dof_frictionloss[self._dof] = 0.0

    def actuate(self) -> None:
        """Set the commands of wheels and person and simulate one physics step; call `compute_dynamics` before."""
        heading, (v, w) = float(self.data.qpos[self._arm][2]), self._wheel_drive.update(self._u).tolist()
        self.data.ctrl[self._motors] = (v * cos(heading), v * sin(heading), w)
        self._move_person()
        mujoco.mj_step2(self.model, self.data)

    def set_configuration(self, q: Array, opening: float | None = None) -> None:
        """Put the base at rest at `q` = (x, y, θ) [m, rad] (set-up and tests only)."""
        del opening
        self.data.qpos[self._arm], self.data.qvel[self._dof] = q, 0.0
        mujoco.mj_forward(self.model, self.data)
        self._reset_commands()

    def state(self) -> PlantState:
        """The pose of the base."""
        return PlantState(configuration=tuple(self.configuration().tolist()))

    def restore(self, state: PlantState) -> None:
        """Put the base at rest at the pose of `state`; raises `ConfigurationError` if it is not that of a base."""
        self._require_size("configuration", state.configuration, len(self.configuration()))
        self.set_configuration(np.array(state.configuration))

    def link_body_names(self) -> dict[str, str]:
        """MuJoCo body name of the only link."""
        return {self.robot_model.links[0].name: f"{ROBOT_PREFIX}link0"}

    def _reset_commands(self) -> None:
        self._u[:] = 0.0
        self._wheel_drive.reset()
