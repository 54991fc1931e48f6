"""Inverse dynamics of an arm: the joint torques of its own motion and weight, by the compiled kernel.

Recursive Newton-Euler equations in the axes of each frame (`kernel/src/dynamics/dbk_inverse_dynamics.c`). The fingers
count as closed and at rest in the hand, and the base is upright.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.errors import ConfigurationError
from dualbrain.robots.model import DynamicModel, RigidBody, RobotModel
from dualbrain.safety.cbf.compiled import _kernel64_wide as compiled
from dualbrain.safety.cbf.kernel import tool_frame

Array = NDArray[np.float64]

GRAVITY = 9.81
"""Acceleration of free fall [m/s²]."""
BASE_JOINTS = 2
"""Number of controls (v, ω) of a mobile base."""
RESTING_BASE: Array = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, GRAVITY])
"""ω, dω/dt and a of a base that is bolted down; gravity counts as an upward acceleration."""
NO_BODY: Array = np.zeros(10)


@dataclass(frozen=True, slots=True, kw_only=True)
class ArmTorque:
    """Joint torques of an arm with n joints [Nm; of a prismatic joint N].

    `own` (n,) moves the arm, `per_load` (n,) moves 1 kg at the origin of the tool frame. `wrist` (6,) and
    `wrist_per_load` (6,) are force [N] and torque [Nm] on the last frame, in its axes and about its origin.
    """

    own: Array
    per_load: Array
    wrist: Array
    wrist_per_load: Array


class ArmDynamics:
    """The dynamic model of the arm of `robot_model`, which a mobile base may move."""

    def __init__(self, robot_model: RobotModel) -> None:
        """Read chain and masses; raises `ConfigurationError` without a dynamic model."""
        dynamics = robot_model.dynamics
        if dynamics is None:
            raise ConfigurationError.stating(
                f"Robot {robot_model.name!r} has no dynamic model.",
                fix="Add `dynamics` (masses, centres, inertias) to its model, or remove `force_sensing`.",
            )
        self.first_joint = BASE_JOINTS if robot_model.is_mobile else 0
        self.n = robot_model.n - self.first_joint
        self._compiled = compiled.Dynamics(_compiled_model(robot_model, dynamics, self.first_joint))

    def torque(self, q: Array, v: Array, acceleration: Array) -> ArmTorque:
        """Torques at the state `q`, `v` of a `RobotState` and `acceleration`, of the length of `v` [rad/s², m/s²]."""
        n, first = self.n, self.first_joint
        base = _base_motion(v, acceleration) if first else RESTING_BASE
        flat = np.empty(2 * n + 12)
        self._compiled.torque(q[len(q) - n :], v[first:], acceleration[first:], base, flat)
        return ArmTorque(
            own=flat[:n], per_load=flat[n : 2 * n], wrist=flat[2 * n : 2 * n + 6], wrist_per_load=flat[2 * n + 6 :]
        )


def _compiled_model(robot_model: RobotModel, dynamics: DynamicModel, first: int) -> dict[str, Any]:
    """The input of the kernel: the chain of the arm and one body for each frame."""
    joints = robot_model.joints[first:]
    bodies = [
        combine_bodies([body for body in dynamics.bodies if body.frame == first + 1 + index])
        for index in range(len(joints))
    ]
    return {
        "n": len(joints),
        "joint_rotation": np.concatenate([quaternion_to_matrix(joint.quaternion).ravel() for joint in joints]),
        "joint_offset": np.concatenate([np.array(joint.translation) for joint in joints]),
        "joint_kind": np.array([float(joint.kind == "prismatic") for joint in joints]),
        "rotor_inertia": np.array(dynamics.rotor_inertia[first:], float),
        "damping": np.array(dynamics.damping[first:], float),
        "tool_offset": tool_frame(robot_model)[1],
        "bodies": np.concatenate(bodies),
    }


def _base_motion(v: Array, acceleration: Array) -> Array:
    """ω, dω/dt and a (9,) of a base with the controls (v, ω): it turns about its axle and never moves sideways."""
    speed, spin = v[:BASE_JOINTS].tolist()
    faster, turn = acceleration[:BASE_JOINTS].tolist()
    return np.array([0.0, 0.0, spin, 0.0, 0.0, turn, faster, speed * spin, GRAVITY])


def combine_bodies(bodies: list[RigidBody]) -> Array:
    """Mass [kg], centre [m] and inertia about it (xx, yy, zz, xy, xz, yz) [kg m²] of the bodies on one frame, (10,)."""
    mass = sum(body.mass for body in bodies)
    if not mass:
        return NO_BODY
    centre = sum((body.mass * np.array(body.centre) for body in bodies), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for body in bodies:
        xx, yy, zz, xy, xz, yz = body.inertia
        arm = np.array(body.centre) - centre
        inertia += np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        inertia += body.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = inertia.tolist()
    return np.array([mass, *centre, xx, yy, zz, xy, xz, yz])
