"""Kinematic twin of an arm in a scene: the joints follow the control exactly, and nothing has mass.

Skills, gate, filter and perception are those of the full simulation; only the physics is replaced, and the control
period is longer (`TWIN_PERIOD`). Fingers that close stop at the half width of the object between them, which they then
carry; a released object comes to rest on the surface below it.

Modelled: kinematics, the moving person, the distances that the filter keeps, and the course of every skill without
`push`. Not modelled: force, friction, slip, mass, tracking errors, contacts of the robot with anything, and objects
that are pushed. An outcome of the twin is therefore no evidence: it selects contracts for the full simulation.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from typing import NamedTuple

import msgspec
import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, HalfSpace, Shape, Sphere
from dualbrain.robots.model import RobotModel
from dualbrain.simulation.plant.plant import MAX_FINGER_SPEED, Plant
from dualbrain.simulation.scenes.scene_builder import ROBOT_PREFIX
from dualbrain.simulation.scenes.scene_spec import ObjectSpec, SceneSpec

Array = NDArray[np.float64]

TWIN_PERIOD = 0.01
"""Control period of the twin [s], the longest that the safety kernel accepts."""
FINGER_WIDTH, PAD_HEIGHT = 0.012, 0.010
"""Half extents of a finger pad across the closing direction, and along the approach of the tool [m]."""
BOWL_BOTTOM = 0.008
"""Height of the inner bottom of a bowl above its underside [m]."""


class _Grip(NamedTuple):
    """An object between the fingers: its name, and its pose in the tool frame."""

    name: str
    position: Array
    rotation: Array
    half_width: float


def twin_model(robot_model: RobotModel) -> RobotModel:
    """`robot_model` with the period of the twin and without a force sensor, which the twin cannot simulate."""
    return msgspec.structs.replace(robot_model, period=TWIN_PERIOD, force_sensing=None)


class TwinPlant(Plant):
    """The kinematic twin of an arm; `robot_model` must be one of `twin_model`."""

    def __init__(self, spec: SceneSpec, robot_model: RobotModel) -> None:
        """Build the scene with the arm at home, as `Plant` does."""
        self._grip: _Grip | None = None
        super().__init__(spec, robot_model)
        self.steps_per_period = 1
        self._tool_site = int(self.model.site(f"{ROBOT_PREFIX}tcp").id)
        self._free_joints = {
            obj.name: int(self.model.jnt_qposadr[self.model.body(obj.name).jntadr[0]])
            for obj in spec.objects
            if self.model.body(obj.name).jntnum[0]
        }
        if spec.mover is not None:
            actuators = range(self._person_actuators.start, self._person_actuators.stop)
            joints = [int(self.model.actuator_trnid[one, 0]) for one in actuators]
            self._person_qpos = np.array([int(self.model.jnt_qposadr[one]) for one in joints])

    def compute_dynamics(self) -> None:
        """Nothing: all quantities are those of the last step."""

    def actuate(self) -> None:
        """Move the joints, the fingers, the carried object and the person for one control period."""
        data, dt = self.data, self.robot_model.period
        self._move_robot(dt)
        self._move_fingers(dt)
        data.time += dt
        self._move_person()
        mujoco.mj_kinematics(self.model, data)
        self._carry()

    def pad_forces(self) -> tuple[float, float]:
        """The commanded grip force on both fingers while they hold an object, else 0 [N]."""
        force = self._grip_force if self._grip else 0.0
        return (force, force)

    def object_velocity(self, name: str) -> Array:
        """The velocity [m/s] of the moving person, shape (3,); 0 for every other object."""
        self._require_known(name)
        if self._person_path is None or self.spec.mover is None or name != self.spec.mover.name:
            return np.zeros(3)
        _, rate = self._person_path.state_at(self.data.time)
        return np.asarray(rate * self._person_path.direction)

    @property
    def carried_object(self) -> str | None:
        """Name of the object between the closed fingers, None without one."""
        return self._grip.name if self._grip else None

    def _move_robot(self, dt: float) -> None:
        u = self._u if self._enabled else np.zeros_like(self._u)
        self.data.qpos[self._arm] += u * dt
        self.data.qvel[self._dof] = u

    def _move_fingers(self, dt: float) -> None:
        """Move both fingers towards the commanded opening; opening releases, closing grips."""
        step, limit = self._target_opening - self._finger_setpoint, MAX_FINGER_SPEED * dt
        opening = self._finger_setpoint + min(max(step, -limit), limit)
        if self._grip and self._target_opening > self._grip.half_width:
            self._release(self._grip)
        elif self._grip:
            opening = self._grip.half_width
        elif step < 0.0 and (found := self._object_between_fingers(opening)):
            self._grip, opening = found, found.half_width
        self._finger_setpoint = opening
        self.data.qpos[self._fingers] = opening

    def _tool(self) -> tuple[Array, Array]:
        return self.data.site_xpos[self._tool_site], self.data.site_xmat[self._tool_site].reshape(3, 3)

    def _object_between_fingers(self, opening: float) -> _Grip | None:
        """The object that fingers opened by `opening` [m] each reach; they push it to the middle."""
        position, rotation = self._tool()
        for obj in self.spec.objects:
            if obj.name not in self._free_joints or isinstance(obj.shape, Bowl):
                continue
            body = self.data.body(obj.name)
            turn = body.xmat.reshape(3, 3)
            offset = rotation.T @ (body.xpos - position)
            half = [half_extent(obj.shape, turn.T @ rotation[:, axis]) for axis in range(3)]
            between = abs(offset[0]) < half[0] + FINGER_WIDTH and abs(offset[2]) < half[2] + PAD_HEIGHT
            if between and opening <= half[1] and abs(offset[1]) < half[1]:
                return _Grip(obj.name, offset * (1.0, 0.0, 1.0), rotation.T @ turn, half[1])
        return None

    def _carry(self) -> None:
        """Move the gripped object with the tool."""
        if self._grip is None:
            return
        position, rotation = self._tool()
        at = self._free_joints[self._grip.name]
        self.data.qpos[at : at + 3] = position + rotation @ self._grip.position
        mujoco.mju_mat2Quat(self.data.qpos[at + 3 : at + 7], (rotation @ self._grip.rotation).ravel())

    def _release(self, grip: _Grip) -> None:
        """Put the object on the surface below it."""
        self._grip, obj = None, self.spec.find(grip.name)
        at, body = self._free_joints[grip.name], self.data.body(grip.name)
        half_height = half_extent(obj.shape, body.xmat.reshape(3, 3)[2])
        spot = self.data.qpos[at : at + 2]
        self.data.qpos[at + 2] = half_height + max(
            (self._surface_height(other, spot) for other in self.spec.objects if other.name != grip.name), default=0.0
        )

    def _surface_height(self, other: ObjectSpec, spot: Array) -> float:
        """Height [m] of the surface of `other` below an object at `spot` (2,), 0 (the table) beside it."""
        body = self.data.body(other.name)
        distance = float(np.linalg.norm(spot - body.xpos[:2]))
        if isinstance(other.shape, Bowl):
            return float(body.xpos[2]) + BOWL_BOTTOM if distance < other.shape.radius - other.shape.wall else 0.0
        up, turn = np.array([0.0, 0.0, 1.0]), body.xmat.reshape(3, 3)
        if (
            isinstance(other.shape, HalfSpace)
            or other.fixed
            or distance > min(half_extent(other.shape, turn[axis]) for axis in (0, 1))
        ):
            return 0.0
        return float(body.xpos[2]) + half_extent(other.shape, turn.T @ up)

    def _move_person(self) -> None:
        if self._person_path is not None and self.spec.mover is not None:
            distance, _ = self._person_path.state_at(self.data.time)
            self.data.qpos[self._person_qpos] = (distance - self._person_start) * self._person_path.direction


def half_extent(shape: Shape, direction: Array) -> float:
    """Half the extent [m] of a solid `shape` along the unit vector `direction` (3,) in its own frame."""
    along = np.abs(direction)
    match shape:
        case Box(half_extents):
            return float(along @ np.asarray(half_extents))
        case Cylinder(radius, half_height):
            return radius * float(np.hypot(along[0], along[1])) + half_height * float(along[2])
        case Capsule(radius, half_length):
            return radius + half_length * float(along[2])
        case Sphere(radius):
            return radius
        case Bowl() | HalfSpace():
            raise TypeError(f"{type(shape).__name__} is not a solid shape")
