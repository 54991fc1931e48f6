"""The arm in a MuJoCo model of others: joint state by joint names, and a comparison with the robot model."""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.filter import SafetyFilter

Array = NDArray[np.float64]

MAX_AXIS_ERROR, MAX_LEVER_ERROR = 1e-3, 2e-3
"""Largest difference of a joint axis (of a unit vector) and of its lever arm to the tool [m] from the robot model."""

CLIP_TOLERANCE = 1e-4
"""Largest part of the range of a joint that its servo may lack [rad or m], for rounding."""


class MujocoArm:
    """The joints of one arm in a MuJoCo model, in the order of the robot model."""

    def __init__(
        self,
        model: Any,
        data: Any,
        robot_model: RobotModel,
        joints: Sequence[str],
        base: str,
        *,
        has_held_base: bool = False,
    ) -> None:
        """The joints called `joints`, one for each joint of `robot_model`, of the arm whose base is the body `base`.

        `has_held_base`: the base has joints in the model that the environment holds in place.

        Raises:
            UnknownNameError: the MuJoCo model has no joint or body of that name.
            ConfigurationError: the base moves, the number of joints differs, or their axes are not those of the robot
                model at the present posture (another robot, another order, another zero).
        """
        self.model, self.data, self.robot_model = model, data, robot_model
        if len(joints) != robot_model.n:
            allowed = f"one for each joint of {robot_model.name}: {', '.join(j.name for j in robot_model.joints)}"
            raise ConfigurationError("joints of the environment", got=list(joints), allowed=allowed)
        self._joints = np.array([find_id(model, mujoco.mjtObj.mjOBJ_JOINT, "joint", name) for name in joints])
        self.base = find_id(model, mujoco.mjtObj.mjOBJ_BODY, "body", base)
        if model.body_weldid[self.base] != 0 and not has_held_base:
            raise ConfigurationError.stating(
                f"The body {base!r} moves in the MuJoCo model.", fix="Name the fixed base of the arm."
            )
        self._check_kinds(joints)
        self._q, self._v = model.jnt_qposadr[self._joints], model.jnt_dofadr[self._joints]
        self._check_axes(joints)

    @property
    def q(self) -> Array:
        """Joint positions (n,) [rad]."""
        return self.data.qpos[self._q].copy()

    @property
    def v(self) -> Array:
        """Joint velocities (n,) [rad/s]."""
        return self.data.qvel[self._v].copy()

    @property
    def dofs(self) -> NDArray[np.intp]:
        """The degrees of freedom (n,) of the joints in the MuJoCo model."""
        return self._v.copy()

    @property
    def position_addresses(self) -> NDArray[np.intp]:
        """The entries (n,) of the joints in `qpos`."""
        return self._q.copy()

    @property
    def bodies(self) -> frozenset[int]:
        """The bodies of the arm with everything that is attached to them."""
        return carried_bodies(self.model, self.base)

    def bodies_from(self, joint: int) -> frozenset[int]:
        """The bodies that the joint number `joint` moves."""
        return carried_bodies(self.model, int(self.model.jnt_bodyid[self._joints[joint]]))

    def to_base(self, position: Array, rotation: Array) -> tuple[Array, Array]:
        """A pose in the world, position (3,) [m] and rotation (3, 3), in the frame of the base."""
        turn = self.data.xmat[self.base].reshape(3, 3).T
        return turn @ (position - self.data.xpos[self.base]), turn @ rotation

    def check_servo_ranges(self) -> None:
        """Refuse position servos that MuJoCo clips to less than the joint limits of the robot model.

        A clipped position is not the safe one. Actuators that exert torques or follow velocities are not checked.

        Raises:
            ConfigurationError: the control range of a servo is narrower than the range of its joint.
        """
        for actuator in range(self.model.nu):
            found = _servo_range(self.model, actuator)
            if found is None or found[0] not in self._joints:
                continue
            joint, low, high = found
            own = self.robot_model.joints[int(np.flatnonzero(self._joints == joint)[0])]
            if low > own.lower.value + CLIP_TOLERANCE or high < own.upper.value - CLIP_TOLERANCE:
                raise ConfigurationError(
                    f"control range of the servo of the joint {self.model.joint(joint).name!r}",
                    got=[low, high],
                    allowed=f"{own.lower.value:g} to {own.upper.value:g} {own.lower.unit} or more, because a safe "
                    "action must not be clipped",
                    fix=f"Narrow the limits of {own.name!r} in the robot model, or widen the `ctrlrange` of the servo.",
                )

    def _check_kinds(self, names: Sequence[str]) -> None:
        kinds = {"revolute": mujoco.mjtJoint.mjJNT_HINGE, "prismatic": mujoco.mjtJoint.mjJNT_SLIDE}
        for joint, name, own in zip(self._joints, names, self.robot_model.joints, strict=True):
            if self.model.jnt_type[joint] != kinds[own.kind]:
                raise ConfigurationError.stating(
                    f"The joint {name!r} of the environment is not {own.kind}, as {own.name!r} is.",
                    fix="Check the names of the joints and their order.",
                )

    def _check_axes(self, names: Sequence[str]) -> None:
        """Compare the line of each joint axis with that of the robot model; a line has no preferred point on it."""
        mujoco.mj_kinematics(self.model, self.data)
        tool = SafetyFilter(self.robot_model).tool(self.q)
        turn = self.data.xmat[self.base].reshape(3, 3).T
        for k, (joint, name) in enumerate(zip(self._joints, names, strict=True)):
            axis = turn @ self.data.xaxis[joint]
            point = turn @ (self.data.xanchor[joint] - self.data.xpos[self.base])
            lever = np.cross(axis, tool.position - point)
            axis_error = float(np.abs(axis - tool.jacobian[3:, k]).max())
            lever_error = float(np.abs(lever - tool.jacobian[:3, k]).max())
            if axis_error > MAX_AXIS_ERROR or lever_error > MAX_LEVER_ERROR:
                own = self.robot_model.joints[k].name
                raise ConfigurationError.stating(
                    f"The joint {name!r} of the environment is not the joint {own!r} of {self.robot_model.name}: its "
                    f"axis differs by {axis_error:.3g}, its lever arm to the tool by {lever_error * 1e3:.1f} mm.",
                    fix="Check the names and their order, and the base; or import the robot of the environment with "
                    "`dualbrain robot init`.",
                )


def _servo_range(model: Any, actuator: int) -> tuple[int, float, float] | None:
    """Joint number, lowest and highest position of a position servo with a control range; None for other actuators.

    Its force is g c + b₀ + b₁ l + b₂ l̇ with the control c and the length l = gear · q, so that it rests at
    q = −(g c + b₀) / (b₁ gear).
    """
    transmissions = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    unclamped = int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
    gear, (offset, stiffness) = float(model.actuator_gear[actuator, 0]), model.actuator_biasprm[actuator, :2]
    if (
        unclamped
        or not model.actuator_ctrllimited[actuator]
        or int(model.actuator_trntype[actuator]) not in transmissions
        or int(model.actuator_biastype[actuator]) != int(mujoco.mjtBias.mjBIAS_AFFINE)
        or int(model.actuator_dyntype[actuator]) == int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
        or stiffness * gear == 0.0
    ):
        return None
    controls = model.actuator_gainprm[actuator, 0] * model.actuator_ctrlrange[actuator]
    low, high = sorted((-(controls + offset) / (stiffness * gear)).tolist())
    return int(model.actuator_trnid[actuator, 0]), low, high


def carried_bodies(model: Any, first: int) -> frozenset[int]:
    """The body `first` of a MuJoCo model with all bodies that are attached to it."""
    members = {first}
    for body in range(first + 1, model.nbody):  # parents have smaller numbers than their children
        if int(model.body_parentid[body]) in members:
            members.add(body)
    return frozenset(members)


def find_id(model: Any, kind: Any, word: str, name: str) -> int:
    """The number of the joint or body `name` of a MuJoCo model; raises `UnknownNameError`."""
    found = int(mujoco.mj_name2id(model, kind, name))
    if found < 0:
        count = model.njnt if kind == mujoco.mjtObj.mjOBJ_JOINT else model.nbody
        known = tuple(mujoco.mj_id2name(model, kind, i) or "" for i in range(count))
        raise UnknownNameError(word, name, known, owner="the MuJoCo model")
    return found
