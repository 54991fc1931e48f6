"""The simulated robot: MuJoCo stepped in lockstep behind the `Robot` protocol.

One `advance()` is one control period of the body, in steps of 1 ms: `sense()` makes everything current, `act()` drives.
A drive (`drive.py`) turns the commanded joint velocity into motor torque within `forcerange`; the gripper's force limit
F is set with each command (the two fingers share one servo of 2 F). When the drive is disabled the motors lose torque
and gravity compensation, and dry-friction brakes hold each joint.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from dualbrain.core.geometry.shapes import Pose
from dualbrain.errors import UnknownName
from dualbrain.robots.interface import Array, Command, RobotState
from dualbrain.robots.model import Body
from dualbrain.simulation.models.mujoco_model import arm_joints, robot_model
from dualbrain.simulation.plant.joint_drive import ARM_GROUP, DriveKind, make_drive, motors_of
from dualbrain.simulation.scenes.moving_person import DAMPING, STIFFNESS, path_of
from dualbrain.simulation.scenes.scene_builder import LOAD, PERIOD, PREFIX, build_model
from dualbrain.simulation.scenes.scene_spec import SceneSpec

BRAKE_SHARE = 1.4  # holding torque of the brakes, above the motors' own limits
BRAKE_SOLREF, BRAKE_SOLIMP = (2.0 * PERIOD, 1.0), (0.9999, 0.9999, 1e-3, 0.5, 2.0)  # hard enough not to creep
FINGER_SPEED = 0.05  # [m/s each], data sheet of the hand
FINGER_LEAD = 0.002  # [m] by which the finger set point may run ahead beyond what the force needs
OPENING_FORCE = 20.0  # [N] per finger available to open, whatever the grip force
SERVO_STIFFNESS = 20000.0  # [N/m] of the finger servo (kp in the model)


class Plant:
    """A MuJoCo world that is driven like the real robot; also holds the truth that only judges may read."""

    def __init__(
        self,
        spec: SceneSpec,
        body: Body,
        *,
        drive: DriveKind = "computed_torque",
        load: float = 0.0,
        visuals: bool = False,
        model_file: Path | None = None,
        menagerie: Path | None = None,
    ) -> None:
        """Build the scene with the arm at `body.home`, drive enabled, fingers open.

        `load` [kg] is fixed at the tool without anybody being told: how well the drive bears what it does not know.
        `visuals` adds the robot's surface meshes where the package is installed (no change in physics); `model_file`
        and `menagerie` name other robot models (see `model_provider.robot_model`).
        """
        self.spec, self.body = spec, body
        robot = robot_model(spec.robot, path=model_file, menagerie=menagerie, visuals=visuals)
        self.model_source, self.has_visuals = robot.source, robot.has_visuals
        self.model = build_model(spec, robot, load=load)
        self.data = mujoco.MjData(self.model)
        self.steps = round(body.period / PERIOD)
        """Steps of physics in one control period."""
        self._u = np.zeros(body.n)
        self._path = path_of(spec.mover) if spec.mover is not None else None
        self._sequence, self._enabled = 0, True
        self._arrange(drive, load)

    def _arrange(self, drive: DriveKind, load: float) -> None:
        """Find the robot's parts in the model, open the fingers and put the arm at home."""
        self._index()
        self._load = self.model.joint(LOAD).qposadr[0] if load > 0.0 else None
        self.drive = make_drive(drive, self.model, self.data)
        self._wanted = float(self.body.gripper.opening.value)
        self._set_force(float(self.body.gripper.force_min.value))
        self.place_arm(np.array(self.body.home))

    # --- the robot protocol -------------------------------------------------------------------------------------

    def read(self) -> RobotState:
        """The newest state: joints as measured, opening as the mean of both fingers, pad forces by contact."""
        data = self.data
        self._sequence += 1
        return RobotState(
            data.time, self._sequence, data.qpos[self._arm].copy(), data.qvel[self._dof].copy(), self._opening(),
            self.pad_forces(), self._enabled,
        )  # fmt: skip

    def pad_forces(self) -> tuple[float, float]:
        """What the left and the right finger pad feel [N]."""
        left, right = self.data.sensordata[self._touch].tolist()
        return (left, right)

    def write(self, command: Command) -> None:
        """Hold `command` until the next one; ignored while the drive is disabled."""
        if not self._enabled:
            return
        self._u[:] = command.u
        self._wanted = command.opening
        if command.force != self._force:
            self._set_force(command.force)

    def stop(self) -> None:
        """Cut the arm's motors and engage the brakes until `enable`; the gripper keeps its last set point and force."""
        self._enabled = False
        self._forget()
        self.model.opt.disableactuator |= 1 << ARM_GROUP
        self.model.dof_frictionloss[self._dof] = self._brakes
        self.model.body_gravcomp[self._moving] = 0.0

    def enable(self) -> None:
        """Release the brakes with a velocity command of zero."""
        self._enabled = True
        self._forget()
        self.model.opt.disableactuator &= ~(1 << ARM_GROUP)
        self.model.dof_frictionloss[self._dof] = 0.0
        self.model.body_gravcomp[self._moving] = 1.0

    # --- the world ----------------------------------------------------------------------------------------------

    def advance(self) -> None:
        """One control period."""
        for _ in range(self.steps):
            self.step()

    def step(self) -> None:
        """One step of physics."""
        self.sense()
        self.act()

    def sense(self) -> None:
        """Make poses, inertia and bias those of the state now."""
        mujoco.mj_step1(self.model, self.data)

    def act(self) -> None:
        """Motors, fingers and forearm get their set points, then time passes by one step; after `sense`."""
        data = self.data
        if self._enabled:
            self._drive()
        opening = self._opening()
        step = self._wanted - self._finger
        limit = FINGER_SPEED * PERIOD
        target = self._finger + (limit if step > limit else -limit if step < -limit else step)
        self._finger = min(max(target, opening - self._lead), opening + self._lead)
        data.ctrl[self._grip] = self._finger
        self._move_mover()
        mujoco.mj_step2(self.model, data)

    @property
    def now(self) -> float:
        """Simulated time [s]."""
        return self.data.time

    @property
    def names(self) -> tuple[str, ...]:
        """Every thing whose truth can be asked for, the mover last."""
        mover = (self.spec.mover.name,) if self.spec.mover is not None else ()
        return (*(thing.name for thing in self.spec.things), *mover)

    def truth(self, name: str) -> Pose:
        """True pose of a thing (a forearm's local z is its long axis); for judges, never for the robot."""
        self._known(name)
        if self.spec.mover is not None and name == self.spec.mover.name:
            quaternion = np.zeros(4)
            mujoco.mju_mat2Quat(quaternion, self.data.geom(name).xmat)
            return Pose(_vector(self.data.geom(name).xpos), _quaternion(quaternion))
        body = self.data.body(name)
        return Pose(_vector(body.xpos), _quaternion(body.xquat))

    def velocity(self, name: str) -> Array:
        """True linear velocity [m/s] of a thing, shape (3,)."""
        self._known(name)
        motion = np.zeros(6)
        body = int(mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, name))
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_BODY, body, motion, 0)
        return motion[3:]

    @property
    def arm_slices(self) -> tuple[slice, slice]:
        """Where the arm's joints lie in MuJoCo's qpos and qvel."""
        return self._arm, self._dof

    def speed(self) -> Array:
        """True velocity (n,) in the body's own terms [rad/s; of a base (v, ω)]."""
        return self.data.qvel[self._dof].copy()

    def tool_pose(self) -> tuple[Array, Array]:
        """True position (3,) and rotation (3, 3) of the tool frame."""
        site = self.data.site(f"{PREFIX}tcp")
        return site.xpos.copy(), site.xmat.reshape(3, 3).copy()

    def tool_speed(self) -> float:
        """True speed of the tool against what the arm is bolted to [m/s]."""
        motion, tool = np.zeros(6), int(self.model.site(f"{PREFIX}tcp").id)
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_SITE, tool, motion, 0)
        return float(np.linalg.norm(motion[3:]))

    def link_poses(self) -> dict[str, Pose]:
        """True pose of every link of the robot by the body's names, for pictures."""
        found = {name: self.data.body(part) for name, part in self.parts().items()}
        return {name: pose_of(part.xpos, part.xquat) for name, part in found.items()}

    def parts(self) -> dict[str, str]:
        """What MuJoCo calls each link of the body."""
        return {link.name: f"{PREFIX}{link.name}" for link in self.body.links}

    def place_arm(self, q: Array, opening: float | None = None) -> None:
        """Put the arm at `q` at rest without passing in between (set-up and tests only)."""
        data = self.data
        data.qpos[self._arm], data.qvel[self._dof] = q, 0.0
        self._finger = float(self.body.gripper.opening.value) if opening is None else opening
        self._wanted = self._finger
        data.qpos[self._fingers], data.qvel[self._finger_dofs] = self._finger, 0.0
        data.ctrl[self._grip] = self._finger
        mujoco.mj_forward(self.model, data)
        if self._load is not None:
            self._take_up(self._load)
        self._forget()

    def ground(self) -> Array:
        """Where the robot stands on the floor (2,) [m]: under its tool, where it has no base of its own."""
        return self.tool_pose()[0][:2]

    # --- inside -------------------------------------------------------------------------------------------------

    def _drive(self) -> None:
        """Hand the commanded velocities to the motors."""
        self.drive.act(self._u)

    def _index(self) -> None:
        model, n = self.model, arm_joints(self.body)
        arm = [model.joint(f"{PREFIX}joint{index + 1}") for index in range(n)]
        fingers = [model.joint(f"{PREFIX}finger_joint{index}") for index in (1, 2)]
        self._arm = slice(int(arm[0].qposadr[0]), int(arm[-1].qposadr[0]) + 1)
        self._fingers = slice(int(fingers[0].qposadr[0]), int(fingers[1].qposadr[0]) + 1)
        self._dof = slice(int(arm[0].dofadr[0]), int(arm[-1].dofadr[0]) + 1)
        self.model.dof_solref[self._dof], self.model.dof_solimp[self._dof] = BRAKE_SOLREF, BRAKE_SOLIMP
        self._finger_dofs = slice(int(fingers[0].dofadr[0]), int(fingers[1].dofadr[0]) + 1)
        self._brakes = BRAKE_SHARE * model.actuator_forcerange[motors_of(model)[0], 1]
        self._grip = int(model.actuator(f"{PREFIX}gripper").id)
        touch = [int(model.sensor(f"{PREFIX}{side}_touch").adr[0]) for side in ("left", "right")]
        self._touch = slice(touch[0], touch[1] + 1)
        links = [*(f"link{index + 1}" for index in range(n)), "hand", "left_finger", "right_finger"]
        self._moving = np.array([int(model.body(f"{PREFIX}{link}").id) for link in links])
        self._index_mover()

    def _index_mover(self) -> None:
        if self.spec.mover is not None:
            ids = [int(self.model.actuator(f"{self.spec.mover.name}_{axis}").id) for axis in "xyz"]
            self._mover_drives = slice(ids[0], ids[-1] + 1)
            self._mover_zero, _ = path_of(self.spec.mover).at(0.0)

    def _move_mover(self) -> None:
        if self._path is not None:
            distance, rate = self._path.at(self.data.time)
            ahead = distance + rate * DAMPING / STIFFNESS - self._mover_zero
            self.data.ctrl[self._mover_drives] = ahead * self._path.direction

    def _forget(self) -> None:
        """No velocity is wanted, no torque remembered."""
        self._u[:] = 0.0
        self.drive.reset()

    def _take_up(self, at: int) -> None:
        """Put the load where the tool is."""
        position, rotation = self.tool_pose()
        self.data.qpos[at : at + 3] = position
        mujoco.mju_mat2Quat(self.data.qpos[at + 3 : at + 7], rotation.ravel())
        mujoco.mj_forward(self.model, self.data)

    def _opening(self) -> float:
        left, right = self.data.qpos[self._fingers].tolist()
        return 0.5 * (left + right)

    def _set_force(self, force: float) -> None:
        """Bound the servo so that each finger presses with at most `force` [N]."""
        self._force = force
        self.model.actuator_forcerange[self._grip] = (-2.0 * force, 2.0 * max(force, OPENING_FORCE))
        self._lead = 2.0 * max(force, OPENING_FORCE) / SERVO_STIFFNESS + FINGER_LEAD

    def _known(self, name: str) -> None:
        if name not in self.names:
            raise UnknownName("thing", name, self.names, owner=f"scene {self.spec.family}")


def pose_of(position: Array, quaternion: Array) -> Pose:
    """A pose from MuJoCo's arrays."""
    return Pose(_vector(position), _quaternion(quaternion))


def _vector(values: Array) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return (x, y, z)


def _quaternion(values: Array) -> tuple[float, float, float, float]:
    w, x, y, z = values.tolist()
    return (w, x, y, z)
