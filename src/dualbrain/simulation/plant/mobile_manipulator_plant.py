"""The simulated mobile manipulator: an arm's plant on a base that drives, behind the same `Robot` protocol.

Its control is u = (v, ω, q̇), its configuration (x, y, θ, q). The base is that of `base_plant` (wheels that do not
slip), the arm that of `plant` with its own drive; each feels the other's motion through MuJoCo alone.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from math import cos, sin

import mujoco
import numpy as np

from dualbrain.robots.interface import Array, RobotState
from dualbrain.robots.mobile_manipulator import BASE_JOINTS as DRIVEN
from dualbrain.robots.mobile_manipulator import BASE_WIDTH
from dualbrain.simulation.models.mujoco_model import BASE_JOINTS, PLATFORM
from dualbrain.simulation.plant.joint_drive import ComputedTorque, DriveKind
from dualbrain.simulation.plant.mobile_base_plant import BRAKES
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.plant.wheel_drive import Wheels
from dualbrain.simulation.scenes.scene_builder import PERIOD, PREFIX

WHEELS_GROUP = 4
"""Group of the actuators that move the platform."""


class CarrierPlant(Plant):
    """A MuJoCo room with an arm on a base."""

    def _arrange(self, drive: DriveKind, load: float) -> None:
        joints = [self.model.joint(f"{PREFIX}{name}") for name in BASE_JOINTS]
        self._stand = slice(int(joints[0].qposadr[0]), int(joints[-1].qposadr[0]) + 1)
        self._roll = slice(int(joints[0].dofadr[0]), int(joints[-1].dofadr[0]) + 1)
        first = int(self.model.actuator(f"{PREFIX}{BASE_JOINTS[0]}").id)
        self._motors = slice(first, first + len(BASE_JOINTS))
        self._wheels = Wheels(self.body)
        super()._arrange(drive, load)

    def read(self) -> RobotState:
        """The newest state: pose of the base and joints, (v, ω) and joint velocities, opening, finger forces."""
        arm = super().read()
        q = np.concatenate([self.data.qpos[self._stand], arm.q])
        return RobotState(arm.stamp, arm.sequence, q, self.speed(), arm.opening, arm.finger_forces, arm.drive_enabled)

    def speed(self) -> Array:
        """True (v, ω, q̇) [m/s, rad/s], v along the base's own x axis."""
        heading = float(self.data.qpos[self._stand][2])
        vx, vy, turn = self.data.qvel[self._roll].tolist()
        return np.array([vx * cos(heading) + vy * sin(heading), turn, *self.data.qvel[self._dof]])

    def configuration(self) -> Array:
        """True (x, y, θ, q), shape (n + 1,)."""
        return np.concatenate([self.data.qpos[self._stand], self.data.qpos[self._arm]])

    def stop(self) -> None:
        """Cut all motors and engage the brakes of wheels and joints until `enable`."""
        super().stop()
        self.model.opt.disableactuator |= 1 << WHEELS_GROUP
        self.model.dof_frictionloss[self._roll] = BRAKES

    def enable(self) -> None:
        """Release the brakes with a velocity command of zero."""
        super().enable()
        self.model.opt.disableactuator &= ~(1 << WHEELS_GROUP)
        self.model.dof_frictionloss[self._roll] = 0.0

    def place_arm(self, q: Array, opening: float | None = None) -> None:
        """Put base and arm at `q` (n + 1,) at rest (set-up and tests only)."""
        self.data.qpos[self._stand], self.data.qvel[self._roll] = q[:BASE_WIDTH], 0.0
        super().place_arm(q[BASE_WIDTH:], opening)

    def ground(self) -> Array:
        """Where the axle stands (2,) [m]."""
        return self.data.qpos[self._stand][:2].copy()

    def tool_speed(self) -> float:
        """True speed of the tool against the platform [m/s]."""
        arm = self.speed()[DRIVEN:]
        jacobian, turning = np.zeros((3, self.model.nv)), np.zeros((3, self.model.nv))
        tool = int(self.model.site(f"{PREFIX}tcp").id)
        mujoco.mj_jacSite(self.model, self.data, jacobian, turning, tool)
        return float(np.linalg.norm(jacobian[:, self._dof] @ arm))

    def parts(self) -> dict[str, str]:
        """What MuJoCo calls the links; the first one is the platform."""
        return super().parts() | {self.body.links[0].name: f"{PREFIX}{PLATFORM}"}

    def _drive(self) -> None:
        before, wheels = self._wheels.speed, self._wheels.follow(self._u[:DRIVEN])
        heading, (v, w) = float(self.data.qpos[self._stand][2]), wheels.tolist()
        c, s = cos(heading), sin(heading)
        self.data.ctrl[self._motors] = (v * c, v * s, w)
        if isinstance(self.drive, ComputedTorque):
            faster, turning = ((wheels - before) / PERIOD).tolist()
            self.drive.carried(self._roll, np.array([faster * c - v * w * s, faster * s + v * w * c, turning]))
        self.drive.act(self._u[DRIVEN:])

    def _forget(self) -> None:
        self._wheels.forget()
        self.data.ctrl[self._motors] = 0.0
        super()._forget()
