"""Simulated force sensor of an arm: what its motors exert, or what it exerts on its wrist, with the declared errors.

    reading = mean over the period of the force at the joint + constant error + white noise

The motors exert the actuator force and the gravity compensation. The wrench at the wrist is MuJoCo's interaction force
between the last link and its parent. Neither contains the contacts themselves, which a robot does not know.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import mujoco
import numpy as np

from dualbrain.robots.interface import Array
from dualbrain.robots.model import ForceSensing

NOISE_BLOCK = 1024
"""Readings for which noise is drawn at once."""


class ForceSensor:
    """The sensor `sensing` of a simulated arm; call `sample` after every physics step."""

    def __init__(
        self,
        sensing: ForceSensing,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        *,
        motors: slice,
        joints: slice,
        wrist_body: str,
        seed: int,
    ) -> None:
        """Measure the `motors` of the `joints` (index range in qvel), or the wrench on `wrist_body`."""
        self.at_wrist = sensing.kind == "wrist_wrench"
        self._model, self._data = model, data
        self._motor_force, self._gravity = data.actuator_force[motors], data.qfrc_gravcomp[joints]
        self._body = int(model.body(wrist_body).id)
        self._rng = np.random.default_rng([seed, len(sensing.noise)])
        accuracy = np.array(sensing.accuracy)
        self._noise, self._error = np.array(sensing.noise), self._rng.uniform(-accuracy, accuracy)
        channels = 6 if self.at_wrist else len(self._motor_force)
        self._pad = len(sensing.noise) - channels
        self._sum, self._count, self._reading = np.zeros(channels), 0, np.zeros(len(sensing.noise))
        self._drawn = np.zeros((0, len(sensing.noise)))
        self._next = 0

    def sample(self) -> None:
        """Add the force of the physics step that has just been made."""
        self._sum += self._wrench() if self.at_wrist else self._motor_force + self._gravity
        self._count += 1

    def read(self) -> Array:
        """The mean since the last call, with errors; torques (n,) [Nm] or wrench (6,) [N, Nm].

        Without a step in between it is the reading of the last call.
        """
        if self._count:
            if self._next == len(self._drawn):
                self._drawn = self._noise * self._rng.standard_normal((NOISE_BLOCK, len(self._noise)))
                self._next = 0
            self._reading = self._error + self._drawn[self._next]
            self._reading[self._pad :] += self._sum / self._count
            self._next += 1
            self._sum[:], self._count = 0.0, 0
        return self._reading.copy()

    def _wrench(self) -> Array:
        """Force and torque on the wrist body, in its axes and about its origin."""
        model, data, body = self._model, self._data, self._body
        mujoco.mj_rnePostConstraint(model, data)
        torque, force = data.cfrc_int[body, :3], data.cfrc_int[body, 3:]
        about = data.subtree_com[model.body_rootid[body]] - data.xpos[body]
        axes = data.xmat[body].reshape(3, 3).T
        return np.concatenate([axes @ force, axes @ (torque + np.cross(about, force))])
