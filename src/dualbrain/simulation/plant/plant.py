"""Simulated robot: MuJoCo stepped in lockstep behind `RobotInterface`.

One `advance()` simulates one control period in physics steps of 1 ms; each step is `compute_dynamics()`, which updates
all quantities of the present state, and `actuate()`, which applies the commands. A drive (`joint_drive.py`) turns the
commanded joint velocity into motor torque within `forcerange`. Each command sets the grip force limit F (one servo with
2 F moves both fingers). While the drive is disabled, the joints have no motor torque and no gravity compensation, and
dry-friction brakes hold them.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from dualbrain.core.geometry.shapes import Pose
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.interface import Array, Command, RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.simulation.models.mujoco_model import load_mujoco_model, n_arm_joints
from dualbrain.simulation.plant.force_sensor import ForceSensor
from dualbrain.simulation.plant.joint_drive import ARM_ACTUATOR_GROUP, DriveKind, make_drive, motor_slices
from dualbrain.simulation.plant.plant_state import PlantState
from dualbrain.simulation.scenes.moving_person import PERSON_DAMPING, PERSON_STIFFNESS, person_path
from dualbrain.simulation.scenes.scene_builder import LOAD_NAME, PHYSICS_PERIOD, ROBOT_PREFIX, build_model
from dualbrain.simulation.scenes.scene_spec import SceneSpec

BRAKE_TORQUE_FACTOR = 1.4  # holding torque of the brakes, relative to the torque limits of the motors
BRAKE_SOLREF, BRAKE_SOLIMP = (2.0 * PHYSICS_PERIOD, 1.0), (0.9999, 0.9999, 1e-3, 0.5, 2.0)  # stiff: no creep
MAX_FINGER_SPEED = 0.05  # [m/s] of each finger, from the data sheet of the hand
FINGER_SETPOINT_LEAD = 0.002  # [m] lead of the finger set point beyond the lead that the grip force needs
MIN_OPENING_FORCE = 20.0  # [N] per finger available for opening, independent of the grip force
SERVO_STIFFNESS = 20000.0  # [N/m] of the finger servo (kp in the model)


class Plant:
    """A MuJoCo simulation of an arm in a scene, commanded like a real robot.

    It also gives access to the ground truth, which only judges and perception models may read.
    """

    def __init__(
        self,
        spec: SceneSpec,
        robot_model: RobotModel,
        *,
        drive: DriveKind = "computed_torque",
        load: float = 0.0,
        visuals: bool = False,
        model_file: Path | None = None,
        menagerie: Path | None = None,
    ) -> None:
        """Build the scene with the arm at `robot_model.home`, drive enabled, fingers open.

        `load` [kg] is a mass at the tool that the drive does not know. `visuals` adds the robot's surface meshes where
        the package is installed (no change in physics). `model_file` and `menagerie` select another MuJoCo model, see
        `load_mujoco_model`. Raises `UnknownNameError` for an unknown robot or drive and `ConfigurationError` for an
        unsuitable model file.
        """
        self.spec, self.robot_model = spec, robot_model
        robot = load_mujoco_model(spec.robot, path=model_file, menagerie=menagerie, visuals=visuals)
        self.model_source, self.has_visuals = robot.source, robot.has_visuals
        self.model = build_model(spec, robot, load=load)
        self.data = mujoco.MjData(self.model)
        self.steps_per_period = round(robot_model.period / PHYSICS_PERIOD)
        """Physics steps per control period."""
        self._u = np.zeros(robot_model.n)
        self._person_path = person_path(spec.mover) if spec.mover is not None else None
        self._sequence, self._enabled = 0, True
        self._set_up(drive, load)

    def _set_up(self, drive: DriveKind, load: float) -> None:
        """Index the robot's elements in the model, open the fingers and put the arm at its home position."""
        self._index()
        self._load_address = self.model.joint(LOAD_NAME).qposadr[0] if load > 0.0 else None
        self.drive = make_drive(drive, self.model, self.data)
        self._force_sensor = self._make_force_sensor()
        self._target_opening = float(self.robot_model.gripper.opening.value)
        self._set_force(float(self.robot_model.gripper.force_min.value))
        self.set_configuration(np.array(self.robot_model.home))

    # --- RobotInterface -----------------------------------------------------------------------------------------

    def read(self) -> RobotState:
        """The measured state: joints, opening as the mean of both fingers, contact forces on the finger pads."""
        data = self.data
        self._sequence += 1
        return RobotState(
            stamp=data.time,
            sequence=self._sequence,
            q=data.qpos[self._arm].copy(),
            v=data.qvel[self._dof].copy(),
            opening=self._measured_opening(),
            finger_forces=self.pad_forces(),
            drive_enabled=self._enabled,
            torques=self._read_force_sensor("motor_torques"),
            wrench=self._read_force_sensor("wrist_wrench"),
        )

    def pad_forces(self) -> tuple[float, float]:
        """Contact force on the left and on the right finger pad [N]."""
        left, right = self.data.sensordata[self._touch_sensors].tolist()
        return (left, right)

    def write(self, command: Command) -> None:
        """Apply `command` until the next one; ignored while the drive is disabled."""
        if not self._enabled:
            return
        self._u[:] = command.u
        self._target_opening = command.opening
        if command.force != self._grip_force:
            self._set_force(command.force)

    def stop(self) -> None:
        """Disable the arm's motors and engage the brakes until `enable`; the gripper keeps set point and force."""
        self._enabled = False
        self._reset_commands()
        self.model.opt.disableactuator |= 1 << ARM_ACTUATOR_GROUP
        self.model.dof_frictionloss[self._dof] = self._brake_torques
        self.model.body_gravcomp[self._moving_bodies] = 0.0

    def enable(self) -> None:
        """Release the brakes and enable the motors with a velocity command of zero."""
        self._enabled = True
        self._reset_commands()
        self.model.opt.disableactuator &= ~(1 << ARM_ACTUATOR_GROUP)
        self.model.dof_frictionloss[self._dof] = 0.0
        self.model.body_gravcomp[self._moving_bodies] = 1.0

    # --- physics and ground truth -------------------------------------------------------------------------------

    def advance(self) -> None:
        """Simulate one control period."""
        for _ in range(self.steps_per_period):
            self.step()

    def step(self) -> None:
        """Simulate one physics step."""
        self.compute_dynamics()
        self.actuate()

    def compute_dynamics(self) -> None:
        """Compute poses, inertia and bias torque for the present state."""
        mujoco.mj_step1(self.model, self.data)

    def actuate(self) -> None:
        """Set the commands of motors, fingers and person and simulate one step; call `compute_dynamics` before."""
        data = self.data
        if self._enabled:
            self._apply_drive()
        opening = self._measured_opening()
        step = self._target_opening - self._finger_setpoint
        limit = MAX_FINGER_SPEED * PHYSICS_PERIOD
        target = self._finger_setpoint + (limit if step > limit else -limit if step < -limit else step)
        self._finger_setpoint = min(max(target, opening - self._max_lead), opening + self._max_lead)
        data.ctrl[self._gripper_actuator] = self._finger_setpoint
        self._move_person()
        mujoco.mj_step2(self.model, data)
        if self._force_sensor is not None:
            self._force_sensor.sample()

    @property
    def now(self) -> float:
        """Simulated time [s]."""
        return self.data.time

    @property
    def object_names(self) -> tuple[str, ...]:
        """Names of all objects with a true pose, the moving person last."""
        mover = (self.spec.mover.name,) if self.spec.mover is not None else ()
        return (*(obj.name for obj in self.spec.objects), *mover)

    def true_pose(self, name: str) -> Pose:
        """True pose of an object (local z of a forearm is its long axis); for judges, never for the robot.

        Raises `UnknownNameError`.
        """
        self._require_known(name)
        if self.spec.mover is not None and name == self.spec.mover.name:
            quaternion = np.zeros(4)
            mujoco.mju_mat2Quat(quaternion, self.data.geom(name).xmat)
            return Pose(_vector(self.data.geom(name).xpos), _quaternion(quaternion))
        body = self.data.body(name)
        return Pose(_vector(body.xpos), _quaternion(body.xquat))

    def object_velocity(self, name: str) -> Array:
        """True linear velocity [m/s] of an object, shape (3,); raises `UnknownNameError`."""
        self._require_known(name)
        motion = np.zeros(6)
        body = int(mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, name))
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_BODY, body, motion, 0)
        return motion[3:]

    @property
    def arm_slices(self) -> tuple[slice, slice]:
        """Index ranges of the arm's joints in MuJoCo's qpos and qvel."""
        return self._arm, self._dof

    def robot_velocity(self) -> Array:
        """True velocity (n,) in the coordinates of the robot model [rad/s; of a base (v, ω) in m/s and rad/s]."""
        return self.data.qvel[self._dof].copy()

    def tool_pose(self) -> tuple[Array, Array]:
        """True position (3,) [m] and rotation matrix (3, 3) of the tool frame."""
        site = self.data.site(f"{ROBOT_PREFIX}tcp")
        return site.xpos.copy(), site.xmat.reshape(3, 3).copy()

    def tool_speed(self) -> float:
        """True speed of the tool relative to the mount of the arm [m/s]."""
        motion, tool = np.zeros(6), int(self.model.site(f"{ROBOT_PREFIX}tcp").id)
        mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_SITE, tool, motion, 0)
        return float(np.linalg.norm(motion[3:]))

    def link_poses(self) -> dict[str, Pose]:
        """True pose of every link, by the link names of the robot model; for rendering."""
        bodies = {name: self.data.body(body) for name, body in self.link_body_names().items()}
        return {name: pose_from_arrays(body.xpos, body.xquat) for name, body in bodies.items()}

    def link_body_names(self) -> dict[str, str]:
        """MuJoCo body name of each link of the robot model."""
        return {link.name: f"{ROBOT_PREFIX}{link.name}" for link in self.robot_model.links}

    def set_configuration(self, q: Array, opening: float | None = None) -> None:
        """Put the arm at rest at `q` (n,) [rad] without moving there (set-up and tests only)."""
        data = self.data
        data.qpos[self._arm], data.qvel[self._dof] = q, 0.0
        self._finger_setpoint = float(self.robot_model.gripper.opening.value) if opening is None else opening
        self._target_opening = self._finger_setpoint
        data.qpos[self._fingers], data.qvel[self._finger_dofs] = self._finger_setpoint, 0.0
        data.ctrl[self._gripper_actuator] = self._finger_setpoint
        mujoco.mj_forward(self.model, data)
        if self._load_address is not None:
            self._place_load(self._load_address)
        self._reset_commands()

    def state(self) -> PlantState:
        """The posture, the fingers and their grip, for a robot at rest."""
        return PlantState(
            configuration=tuple(self.configuration().tolist()),
            fingers=tuple(self.data.qpos[self._fingers].tolist()),
            finger_setpoint=self._finger_setpoint,
            target_opening=self._target_opening,
            grip_force=self._grip_force,
        )

    def restore(self, state: PlantState) -> None:
        """Put the robot at rest into `state`; raises `ConfigurationError` if that is not a state of this robot."""
        self._require_size("configuration", state.configuration, len(self.configuration()))
        self._require_size("fingers", state.fingers, self._fingers.stop - self._fingers.start)
        self.set_configuration(np.array(state.configuration), state.target_opening)
        self._set_force(state.grip_force)
        self._finger_setpoint = self.data.ctrl[self._gripper_actuator] = state.finger_setpoint
        self.data.qpos[self._fingers] = state.fingers
        mujoco.mj_forward(self.model, self.data)

    def configuration(self) -> Array:
        """True configuration (nq,), as in `RobotState.q`."""
        return self.data.qpos[self._arm].copy()

    def ground_position(self) -> Array:
        """Position (2,) [m] of the robot on the floor; for an arm without a base, the position of its tool."""
        return self.tool_pose()[0][:2]

    # --- internals ----------------------------------------------------------------------------------------------

    def _make_force_sensor(self) -> ForceSensor | None:
        """The sensor that the robot model declares, None without one."""
        sensing = self.robot_model.force_sensing
        if sensing is None:
            return None
        return ForceSensor(
            sensing,
            self.model,
            self.data,
            motors=motor_slices(self.model)[0],
            joints=self._dof,
            wrist_body=f"{ROBOT_PREFIX}link{n_arm_joints(self.robot_model)}",
            seed=self.spec.seed,
        )

    def _read_force_sensor(self, kind: str) -> Array | None:
        """The reading of the sensor of this kind, None if the robot has another or none."""
        sensing = self.robot_model.force_sensing
        return self._force_sensor.read() if self._force_sensor and sensing and sensing.kind == kind else None

    def _apply_drive(self) -> None:
        """Apply the commanded velocities to the motors."""
        self.drive.apply(self._u)

    def _index(self) -> None:
        model, n = self.model, n_arm_joints(self.robot_model)
        arm = [model.joint(f"{ROBOT_PREFIX}joint{index + 1}") for index in range(n)]
        fingers = [model.joint(f"{ROBOT_PREFIX}finger_joint{index}") for index in (1, 2)]
        self._arm = slice(int(arm[0].qposadr[0]), int(arm[-1].qposadr[0]) + 1)
        self._fingers = slice(int(fingers[0].qposadr[0]), int(fingers[1].qposadr[0]) + 1)
        self._dof = slice(int(arm[0].dofadr[0]), int(arm[-1].dofadr[0]) + 1)
        self.model.dof_solref[self._dof], self.model.dof_solimp[self._dof] = BRAKE_SOLREF, BRAKE_SOLIMP
        self._finger_dofs = slice(int(fingers[0].dofadr[0]), int(fingers[1].dofadr[0]) + 1)
        self._brake_torques = BRAKE_TORQUE_FACTOR * model.actuator_forcerange[motor_slices(model)[0], 1]
        self._gripper_actuator = int(model.actuator(f"{ROBOT_PREFIX}gripper").id)
        touch = [int(model.sensor(f"{ROBOT_PREFIX}{side}_touch").adr[0]) for side in ("left", "right")]
        self._touch_sensors = slice(touch[0], touch[1] + 1)
        links = [*(f"link{index + 1}" for index in range(n)), "hand", "left_finger", "right_finger"]
        self._moving_bodies = np.array([int(model.body(f"{ROBOT_PREFIX}{link}").id) for link in links])
        self._index_moving_person()

    def _index_moving_person(self) -> None:
        if self.spec.mover is not None:
            ids = [int(self.model.actuator(f"{self.spec.mover.name}_{axis}").id) for axis in "xyz"]
            self._person_actuators = slice(ids[0], ids[-1] + 1)
            self._person_start, _ = person_path(self.spec.mover).state_at(0.0)

    def _move_person(self) -> None:
        if self._person_path is not None:
            distance, rate = self._person_path.state_at(self.data.time)
            ahead = distance + rate * PERSON_DAMPING / PERSON_STIFFNESS - self._person_start
            self.data.ctrl[self._person_actuators] = ahead * self._person_path.direction

    def _reset_commands(self) -> None:
        """Command a velocity of zero and reset the drive."""
        self._u[:] = 0.0
        self.drive.reset()

    def _place_load(self, at: int) -> None:
        """Put the load at the tool; `at` is its index in qpos."""
        position, rotation = self.tool_pose()
        self.data.qpos[at : at + 3] = position
        mujoco.mju_mat2Quat(self.data.qpos[at + 3 : at + 7], rotation.ravel())
        mujoco.mj_forward(self.model, self.data)

    def _measured_opening(self) -> float:
        left, right = self.data.qpos[self._fingers].tolist()
        return 0.5 * (left + right)

    def _set_force(self, force: float) -> None:
        """Limit the servo so that each finger presses with at most `force` [N]."""
        self._grip_force = force
        self.model.actuator_forcerange[self._gripper_actuator] = (-2.0 * force, 2.0 * max(force, MIN_OPENING_FORCE))
        self._max_lead = 2.0 * max(force, MIN_OPENING_FORCE) / SERVO_STIFFNESS + FINGER_SETPOINT_LEAD

    def _require_size(self, name: str, values: tuple[float, ...], size: int) -> None:
        if len(values) != size:
            what = f"{name} of robot {self.robot_model.name} at the end of the earlier run"
            raise ConfigurationError(what, got=f"{len(values)} numbers", allowed=f"{size} numbers")

    def _require_known(self, name: str) -> None:
        if name not in self.object_names:
            raise UnknownNameError("object", name, self.object_names, owner=f"scene {self.spec.family}")


def pose_from_arrays(position: Array, quaternion: Array) -> Pose:
    """The pose for a position (3,) [m] and a quaternion (4,) (w, x, y, z)."""
    return Pose(_vector(position), _quaternion(quaternion))


def _vector(values: Array) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return (x, y, z)


def _quaternion(values: Array) -> tuple[float, float, float, float]:
    w, x, y, z = values.tolist()
    return (w, x, y, z)
