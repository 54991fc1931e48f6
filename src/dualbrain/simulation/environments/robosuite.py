"""The filter between the controllers of a robosuite environment and the motors of its arm.

robosuite turns every action of a policy (20 Hz) into joint torques at 500 Hz: by its operational-space controller, its
joint-position controller, or directly. The guard filters these torques, in every step of the physics and at the
measured joint state: the nominal control is the velocity that a torque causes, u_nom = v + dt M⁻¹(τ + p − b)
(`JointTorque`). A torque that is safe reaches the motors bit for bit; any other one is replaced by the torque that
tracks the closest safe velocity. The lag of robosuite's compliant controllers (0.16 s) and the redundant motion of the
elbow are therefore no matter of the filter's margins.

Arm, obstacles and period come from the environment. robosuite itself is not imported.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import msgspec
import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import Bound, RobotModel, TrackingErrorModel
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.integration.derating import derate
from dualbrain.safety.integration.policy_guard.action_layout import as_numbers
from dualbrain.safety.integration.policy_guard.guard import GuardReport, PolicyGuard
from dualbrain.safety.integration.policy_guard.step_info import step_info
from dualbrain.safety.integration.policy_guard.torque_actions import JointTorque
from dualbrain.simulation.environments.mujoco_arm import MujocoArm, find_id
from dualbrain.simulation.environments.mujoco_obstacles import MujocoObstacles
from dualbrain.simulation.environments.mujoco_torque_drive import MujocoTorqueDrive

Array = NDArray[np.float64]

DRIVE = "robosuite"
CONTROLLERS = ("OSC_POSE", "OSC_POSITION", "IK_POSE", "JOINT_POSITION", "JOINT_TORQUE")
"""Controllers whose result are joint torques. JOINT_VELOCITY does not run in robosuite 1.5.2."""
_MANIPULATED = {
    "Lift": lambda env: env.cube,
    "Stack": lambda env: env.cubeA,
    "PickPlaceSingle": lambda env: env.objects[env.object_id],
    "PickPlaceMilk": lambda env: env.objects[env.object_id],
    "PickPlaceBread": lambda env: env.objects[env.object_id],
    "PickPlaceCereal": lambda env: env.objects[env.object_id],
    "PickPlaceCan": lambda env: env.objects[env.object_id],
}
"""The object that each task is about, by the class of the environment."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _ArmLimits:
    """A robot of robosuite: our robot model and gripper, and limits within which its motors follow the filter.

    `speed_shares` and `acceleration_shares` (n,) are shares of the limits of the robot model, and `position_error` (n,)
    [rad] is the tracking error within them.
    """

    robot: str
    gripper: str
    speed_shares: tuple[float, ...]
    acceleration_shares: tuple[float, ...]
    position_error: tuple[float, ...]


_ROBOTS = {
    "Panda": _ArmLimits(
        robot="panda",
        gripper="PandaGripper",
        speed_shares=(0.25, 0.25, 0.25, 0.25, 0.15, 0.15, 0.15),
        acceleration_shares=(0.25, 0.25, 0.25, 0.25, 0.25, 0.12, 0.12),
        position_error=(2e-3,) * 7,
    )
}
"""Limits: robosuite's motors move 0.7 to 5 kg m² of armature, and its fingertips have an air drag that takes 12 Nm of a
hand turning at 1 rad/s. Errors: docs/experiments/robots/robosuite_guard.md."""


def guard_robosuite(
    env: Any,
    *,
    manipulated: Collection[str] | None = None,
    margin: float = 0.0,
    config: FilterConfig | None = None,
) -> RobosuiteGuard:
    """`env`, an environment of robosuite with one Panda, with the torques of its controllers filtered.

    `manipulated` are the names of the bodies that the arm may touch, with all bodies attached to them; by default the
    cube of Lift, the first cube of Stack and the object of PickPlaceCan and its like. Everything else that collides is
    an obstacle: table, walls of the bins, mount, floor, other objects; `margin` [m] enlarges them.

    Raises:
        ConfigurationError: another robot or gripper, more than one arm, a controller without joint torques, or a task
            whose objects are unknown.
        UnknownNameError: the simulation has no body of a name.
    """
    return RobosuiteGuard(env, manipulated=manipulated, margin=margin, config=config)


def robosuite_robot(env: Any) -> RobotModel:
    """The robot model of the arm in `env`: with its physics step as period, and derated to its motors.

    Raises `ConfigurationError` for another robot or gripper, or more than one arm.
    """
    limits = _only_robot(env)[1]
    model = load_robot(limits.robot)
    shares = zip(model.joints, limits.speed_shares, strict=True)
    speeds = [share * joint.velocity.value for joint, share in shares]
    model = derate(model, period=float(env.model_timestep), max_speed=speeds)
    joints = tuple(
        msgspec.structs.replace(joint, acceleration=Bound(share * joint.acceleration.value, "rad/s^2", "motors"))
        for joint, share in zip(model.joints, limits.acceleration_shares, strict=True)
    )
    model = msgspec.structs.replace(model, joints=joints)
    tracking = TrackingErrorModel(
        lag=0.0,
        position_error=limits.position_error,
        rate=model.alpha,
        provenance="robosuite 1.5.2: docs/experiments/robots/robosuite_guard.md",
        drive=DRIVE,
    )
    return model.with_tracking(tracking).with_drive(DRIVE)


class RobosuiteGuard:
    """A robosuite environment with a guarded arm; it has the interface of the environment.

    `step` and `reset` return the values of `env`. `info` of a step also contains `cost`, `cost_rows`, `h_min` [m],
    `status`, `safety` (a sentence), `changed` (whether a torque was replaced) and `tracking_error` (n,) [rad], the
    largest |∫ exp(−α (t − s)) (v − u) ds| of each joint since the last reset. The guarantee holds while it is at most
    the `position_error` of `safety.robot_model.tracking`.

    An action that is not finite or of another size brings the arm to rest; the gripper keeps its last command.
    """

    def __init__(
        self, env: Any, *, manipulated: Collection[str] | None, margin: float, config: FilterConfig | None
    ) -> None:
        """Guard `env`, as `guard_robosuite` states."""
        self.env, self._inner = env, getattr(env, "unwrapped", env)
        self._robot_model = robosuite_robot(self._inner)
        _check_controller(self._inner)
        self._given, self._margin, self._config = manipulated, margin, config
        self._control_motors = self._inner._pre_action
        self._inner._pre_action = self._pre_action
        self._reports: list[GuardReport] = []
        self._problem, self._last_action = "", np.zeros(int(self._inner.action_dim))
        self._connect()

    def __getattr__(self, name: str) -> Any:
        """Everything else is that of the environment."""
        if name.startswith("__") or name == "env":
            raise AttributeError(name)
        return getattr(self.env, name)

    @property
    def safety(self) -> SafetyFilter:
        """The filter; a reset builds another one, because robosuite builds its model again."""
        return self._guard.safety

    @property
    def ignored(self) -> tuple[str, ...]:
        """The bodies that the arm may touch."""
        return self._ignored

    def reset(self, *arguments: Any, **options: Any) -> Any:
        """Reset the environment, and read arm and obstacles from its new model."""
        self._connected = False
        try:
            found = self.env.reset(*arguments, **options)
        finally:
            self._connect()
        return found

    def step(self, action: Any) -> tuple[Any, ...]:
        """Execute `action`; the torques that robosuite's controllers compute from it pass the filter."""
        numbers = as_numbers(action, len(self._last_action))
        self._problem = f"{numbers}; the arm comes to rest" if isinstance(numbers, str) else ""
        if isinstance(numbers, str):
            action = self._resting_action()
        else:
            self._last_action = numbers
        self._reports, self._changed = [], False
        *found, info = self.env.step(action)
        self._measure()
        own = {**step_info(self._reports), "changed": self._changed, "tracking_error": self._worst_error.copy()}
        return (*found, {**info, **own})

    # --- the model of the present episode -----------------------------------------------------------------------

    def _connect(self) -> None:
        """Build the guard for the present model of the environment."""
        env, robot = self._inner, self._inner.robots[0]
        model, data = env.sim.model._model, env.sim.data._data
        self._data, self._actuators = data, np.asarray(robot._ref_arm_joint_actuator_indexes, int)
        prefix = robot.robot_model.naming_prefix
        arm = MujocoArm(model, data, self._robot_model, robot.robot_model.arm_joints, f"{prefix}link0")
        names = _manipulated_bodies(env) if self._given is None else tuple(self._given)
        self._ignored = _with_descendants(model, names)
        fixed = {model.body(body).name for body in range(model.nbody) if model.body_weldid[body] == 0}
        obstacles = MujocoObstacles(arm, ignored=self._ignored, margin=self._margin).observe()
        self._moving = MujocoObstacles(arm, ignored={*self._ignored, *fixed}, margin=self._margin)
        static = [obstacle for obstacle in obstacles if obstacle.static]
        self._observes = len(static) < len(obstacles)
        safety = SafetyFilter(self._robot_model, self._config, obstacles=static)
        self._guard, self._arm = PolicyGuard(safety, JointTorque(drive=MujocoTorqueDrive(arm))), arm
        self._low, self._high = model.actuator_ctrlrange[self._actuators].T
        self._control, self._connected = None, True
        self._error, self._worst_error = np.zeros(self._robot_model.n), np.zeros(self._robot_model.n)

    # --- one step of the physics --------------------------------------------------------------------------------

    def _pre_action(self, action: Any, policy_step: bool = False) -> None:
        """Let robosuite's controllers set the motors, and filter the torques of the arm."""
        self._control_motors(action, policy_step)
        if not self._connected:
            return
        self._measure()
        torque, q, v, now = self._data.ctrl[self._actuators], self._arm.q, self._arm.v, float(self._data.time)
        if self._observes:
            self._guard.safety.observe(self._moving.observe(), now)
        safe = self._guard.stop(self._problem, q, v, now) if self._problem else self._guard(torque, q, v, now)
        if safe is not torque:
            self._data.ctrl[self._actuators] = np.clip(safe, self._low, self._high)
            self._changed = True
        self._control = self._guard.control
        self._reports.append(self._guard.report)

    def _measure(self) -> None:
        """Compare the joint velocities with the control of the period before, once."""
        if self._control is not None:
            dt, rate = self._robot_model.period, self._robot_model.tracking.rate
            self._error = np.exp(-rate * dt) * self._error + dt * (self._arm.v - self._control)
            self._worst_error, self._control = np.maximum(self._worst_error, np.abs(self._error)), None

    def _resting_action(self) -> Array:
        """No motion of the arm; the gripper keeps its command."""
        resting = np.zeros(len(self._last_action))
        for part, (start, end) in self._inner.robots[0]._action_split_indexes.items():
            if part.endswith("gripper"):
                resting[start:end] = self._last_action[start:end]
        return resting


# --- conditions of the guarantee ------------------------------------------------------------------------------------


def _only_robot(env: Any) -> tuple[Any, _ArmLimits]:
    """The robot of the environment, and its limits."""
    robots: list[Any] = list(getattr(env, "robots", ()))
    if not robots or not hasattr(env, "_pre_action") or not hasattr(env, "model_timestep"):
        raise ConfigurationError.stating(
            f"{type(env).__name__} is no environment of robosuite 1.5.",
            fix="Pass the result of `robosuite.make`; `guard_mujoco_env` guards other environments.",
        )
    arms = [f"{robot.name} {arm}" for robot in robots for arm in robot.arms]
    if len(arms) != 1:
        raise ConfigurationError(
            "arms of the robosuite environment", got=arms, allowed="one arm", fix="Choose a robot with one arm."
        )
    robot = robots[0]
    if robot.name not in _ROBOTS:
        raise ConfigurationError(
            "robot of the robosuite environment",
            got=robot.name,
            allowed=", ".join(_ROBOTS),
            fix="Choose it with `robosuite.make(..., robots=...)`, or use `guard_mujoco_env` with your robot model.",
        )
    limits = _ROBOTS[robot.name]
    gripper = type(robot.gripper[robot.arms[0]]).__name__
    if gripper != limits.gripper:
        raise ConfigurationError(
            "gripper of the robosuite environment",
            got=gripper,
            allowed=limits.gripper,
            fix="Its shape is part of the robot model: leave out `gripper_types`.",
        )
    return robot, limits


def _check_controller(env: Any) -> None:
    """Raise `ConfigurationError` unless the controller of the arm computes torques, and its motors exert them."""
    robot = env.robots[0]
    name = robot.part_controllers[robot.arms[0]].name
    if name not in CONTROLLERS:
        raise ConfigurationError(
            "controller of the arm",
            got=name,
            allowed=", ".join(CONTROLLERS),
            fix="Choose another one with `controller_configs`.",
        )
    model, motors = env.sim.model._model, np.asarray(robot._ref_arm_joint_actuator_indexes, int)
    plain = (model.actuator_biastype[motors] == 0) & (model.actuator_gaintype[motors] == 0)
    if not (plain.all() and (model.actuator_gear[motors, 0] == 1.0).all()):
        raise ConfigurationError.stating(
            f"The actuators of {robot.name} do not exert the torques that they are given.",
            fix="Use the robot of robosuite with its torque motors.",
        )


def _manipulated_bodies(env: Any) -> tuple[str, ...]:
    """The root body of the object that the task is about."""
    task = type(env).__name__
    if task not in _MANIPULATED:
        raise ConfigurationError.stating(
            f"The bodies that the arm may touch in {task} are unknown.",
            fix="Pass their names: `guard_robosuite(env, manipulated=(...))`; an empty tuple forbids every contact.",
        )
    return (_MANIPULATED[task](env).root_body,)


def _with_descendants(model: Any, names: Collection[str]) -> tuple[str, ...]:
    """The bodies called `names` and all bodies that are attached to them."""
    members: set[int] = {find_id(model, mujoco.mjtObj.mjOBJ_BODY, "body", name) for name in names}
    for body in range(1, model.nbody):  # parents have smaller numbers than their children
        if int(model.body_parentid[body]) in members:
            members.add(body)
    return tuple(model.body(body).name for body in sorted(members))
