"""Joint positions of one arm of gym-aloha for a pose of its hand, by damped least squares from the start posture."""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

JOINTS = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
GRASP = np.array([0.14, 0.0, 0.0])
"""The point between the tips of the fingers in the body of the gripper [m]."""
START = np.array([0.0, -0.96, 1.16, 0.0, -0.3, 0.0])
DAMPING, MAX_STEP, N_ITERATIONS, TOLERANCE = 1e-4, 0.1, 400, 1e-3


class InverseKinematics:
    """The arm of one `side` in a copy of the state of the simulation."""

    def __init__(self, model: Any, side: str) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        joints = [model.joint(f"vx300s_{side}/{name}") for name in JOINTS]
        self._q = [int(joint.qposadr[0]) for joint in joints]
        self._v = [int(joint.dofadr[0]) for joint in joints]
        self._low, self._high = np.array([joint.range for joint in joints]).T
        self._hand = int(model.body(f"vx300s_{side}/gripper_link").id)

    def solve(self, position: Array, rotation: Array, start: Array = START) -> Array:
        """Joint positions (6,) [rad] with the grasp point at `position` (3,) [m] and the gripper at `rotation` (3, 3).

        Raises:
            ValueError: there are none near `start`.
        """
        q, jacobian = start.copy(), np.zeros((6, self._model.nv))
        for _ in range(N_ITERATIONS):
            self._data.qpos[self._q] = q
            mujoco.mj_kinematics(self._model, self._data)
            mujoco.mj_comPos(self._model, self._data)
            turn = self._data.xmat[self._hand].reshape(3, 3)
            point = self._data.xpos[self._hand] + turn @ GRASP
            error = np.concatenate([position - point, _rotation_vector(rotation @ turn.T)])
            if float(np.abs(error).max()) < TOLERANCE:
                return q
            mujoco.mj_jac(self._model, self._data, jacobian[:3], jacobian[3:], point, self._hand)
            J = jacobian[:, self._v]
            step = J.T @ np.linalg.solve(J @ J.T + DAMPING * np.eye(6), error)
            q = np.clip(q + step * min(1.0, MAX_STEP / float(np.abs(step).max())), self._low, self._high)
        raise ValueError(f"no posture at {position.round(3).tolist()}: error {np.abs(error).max():.3f}")


def _rotation_vector(turn: Array) -> Array:
    quaternion, vector = np.zeros(4), np.zeros(3)
    mujoco.mju_mat2Quat(quaternion, turn.ravel())
    mujoco.mju_quat2Vel(vector, quaternion, 1.0)
    return vector
