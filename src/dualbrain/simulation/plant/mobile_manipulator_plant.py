"""Simulated mobile manipulator behind `RobotInterface`: an arm on a differential-drive base.

The control is u = (v, ω, q̇), the configuration (x, y, θ, q). The base is that of `MobileBasePlant` (wheels that do not
slip), the arm that of `Plant` with its own drive; MuJoCo simulates the coupling between the two.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from math import cos, sin

import mujoco
import numpy as np

from dualbrain.robots.interface import Array, RobotState
from dualbrain.robots.mobile_manipulator import BASE_JOINTS, BASE_NQ
from dualbrain.simulation.models.mujoco_model import BASE_JOINT_NAMES, PLATFORM_BODY
from dualbrain.simulation.plant.joint_drive import ComputedTorqueDrive, DriveKind
from dualbrain.simulation.plant.mobile_base_plant import BRAKE_FRICTION
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.plant.wheel_drive import WheelDrive
from dualbrain.simulation.scenes.scene_builder import PHYSICS_PERIOD, ROBOT_PREFIX

WHEEL_ACTUATOR_GROUP = 4
"""Group of the actuators that move the platform."""


class MobileManipulatorPlant(Plant):
    """A MuJoCo simulation of a mobile manipulator in a room."""

    def _set_up(self, drive: DriveKind, load: float) -> None:
        joints = [self.model.joint(f"{ROBOT_PREFIX}{name}") for name in BASE_JOINT_NAMES]
        self._base_qpos = slice(int(joints[0].qposadr[0]), int(joints[-1].qposadr[0]) + 1)
        self._base_qvel = slice(int(joints[0].dofadr[0]), int(joints[-1].dofadr[0]) + 1)
        first = int(self.model.actuator(f"{ROBOT_PREFIX}{BASE_JOINT_NAMES[0]}").id)
        self._motors = slice(first, first + len(BASE_JOINT_NAMES))
        self._wheel_drive = WheelDrive(self.robot_model)
        super()._set_up(drive, load)

    def read(self) -> RobotState:
        """The measured state: q = (x, y, θ, q), v = (v, ω, q̇), opening and finger forces."""
        arm = super().read()
        q = np.concatenate([self.data.qpos[self._base_qpos], arm.q])
        return RobotState(
            stamp=arm.stamp,
            sequence=arm.sequence,
            q=q,
            v=self.robot_velocity(),
            opening=arm.opening,
            finger_forces=arm.finger_forces,
            drive_enabled=arm.drive_enabled,
            torques=arm.torques,
            wrench=arm.wrench,
        )

    def robot_velocity(self) -> Array:
        """True (v, ω, q̇) [m/s, rad/s], v along the x axis of the base."""
        heading = float(self.data.qpos[self._base_qpos][2])
        vx, vy, turn = self.data.qvel[self._base_qvel].tolist()
        return np.array([vx * cos(heading) + vy * sin(heading), turn, *self.data.qvel[self._dof]])

    def configuration(self) -> Array:
        """True (x, y, θ, q), shape (n + 1,)."""
        return np.concatenate([self.data.qpos[self._base_qpos], self.data.qpos[self._arm]])

    def stop(self) -> None:
        """Disable all motors and engage the brakes of wheels and joints until `enable`."""
        super().stop()
        self.model.opt.disableactuator |= 1 << WHEEL_ACTUATOR_GROUP
        self.model.dof_frictionloss[self._base_qvel] = BRAKE_FRICTION

    def enable(self) -> None:
        """Release the brakes and enable the motors with a velocity command of zero."""
        super().enable()
        self.model.opt.disableactuator &= ~(1 << WHEEL_ACTUATOR_GROUP)
        self.model.dof_frictionloss[self._base_qvel] = 0.0

    def set_configuration(self, q: Array, opening: float | None = None) -> None:
        """Put base and arm at rest at `q` (n + 1,) [m, rad] (set-up and tests only)."""
        self.data.qpos[self._base_qpos], self.data.qvel[self._base_qvel] = q[:BASE_NQ], 0.0
        super().set_configuration(q[BASE_NQ:], opening)

    def ground_position(self) -> Array:
        """Position (2,) [m] of the axle on the floor."""
        return self.data.qpos[self._base_qpos][:2].copy()

    def tool_speed(self) -> float:
        """True speed of the tool relative to the platform [m/s]."""
        arm = self.robot_velocity()[BASE_JOINTS:]
        jacobian, turning = np.zeros((3, self.model.nv)), np.zeros((3, self.model.nv))
        tool = int(self.model.site(f"{ROBOT_PREFIX}tcp").id)
        mujoco.mj_jacSite(self.model, self.data, jacobian, turning, tool)
        return float(np.linalg.norm(jacobian[:, self._dof] @ arm))

    def link_body_names(self) -> dict[str, str]:
        """MuJoCo body name of each link; the first link is the platform."""
        return super().link_body_names() | {self.robot_model.links[0].name: f"{ROBOT_PREFIX}{PLATFORM_BODY}"}

    def _apply_drive(self) -> None:
        before, wheels = self._wheel_drive.velocity, self._wheel_drive.update(self._u[:BASE_JOINTS])
        heading, (v, w) = float(self.data.qpos[self._base_qpos][2]), wheels.tolist()
        c, s = cos(heading), sin(heading)
        self.data.ctrl[self._motors] = (v * c, v * s, w)
        if isinstance(self.drive, ComputedTorqueDrive):
            faster, turning = ((wheels - before) / PHYSICS_PERIOD).tolist()
            self.drive.set_base_acceleration(
                self._base_qvel, np.array([faster * c - v * w * s, faster * s + v * w * c, turning])
            )
        self.drive.apply(self._u[BASE_JOINTS:])

    def _reset_commands(self) -> None:
        self._wheel_drive.reset()
        self.data.ctrl[self._motors] = 0.0
        super()._reset_commands()
