"""The filter in front of the arm of any Gymnasium environment that simulates with MuJoCo.

The adapter reads joint state and obstacles from the simulation, not from the observation, because every suite has
another layout; on a robot both come from its sensors.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np

from dualbrain.errors import ConfigurationError
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.integration.gym_env import FilteredEnv
from dualbrain.safety.integration.policy_guard.action_space import ActionSpace
from dualbrain.safety.integration.policy_guard.guard import Deviation
from dualbrain.safety.integration.policy_guard.joint_actions import JointPosition
from dualbrain.simulation.environments.mujoco_arm import MujocoArm
from dualbrain.simulation.environments.mujoco_obstacles import MujocoObstacles

MujocoHandles = tuple[Any, Any]
"""`MjModel` and `MjData` of an environment."""


def guard_mujoco_env(
    env: Any,
    robot_model: RobotModel,
    action_space: ActionSpace,
    *,
    joints: Sequence[str] | None = None,
    base: str,
    ignored: Collection[str] = (),
    margin: float = 0.0,
    config: FilterConfig | None = None,
    deviation: Deviation = "nearest",
    step_time: float | None = None,
) -> FilteredEnv:
    """`env`, which is reset once, with every action of its arm replaced by the closest safe one.

    `joints` are the names of the arm's joints in the MuJoCo model, by default those of `robot_model`; `base` is the
    body at its base. Bodies in `ignored` are no obstacles: the policy may touch them. `margin` [m] enlarges obstacles.
    The time of one step of the environment must be a multiple of the period of `robot_model` (`derate`); `step_time`
    [s] states it for an environment that does not (`FilteredEnv`).

    Raises:
        ConfigurationError: the environment has no MuJoCo simulation, its arm is not that of `robot_model`, the time of
            one step is unknown or does not fit, or its actions are narrower than the velocity limits of `robot_model`
            (for joint positions: its actions or the control ranges of its position servos are narrower than the joint
            limits).
        UnknownNameError: its model has no joint or body of a name.
    """
    env.reset()
    arm_joints = tuple(joint.name for joint in robot_model.joints) if joints is None else tuple(joints)
    adapter = _Adapter(env, robot_model, arm_joints, base, ignored, margin)
    if isinstance(action_space, JointPosition):
        adapter.arm.check_servo_ranges()
    return FilteredEnv(
        env,
        SafetyFilter(robot_model, config),
        state=lambda _: (adapter.arm.q, adapter.arm.v),
        scene=lambda _, __: adapter.obstacles.observe(),
        action_space=action_space,
        deviation=deviation,
        step_time=step_time,
    )


class _Adapter:
    """Arm and obstacles of the present model of an environment, which some suites build again in every reset."""

    def __init__(
        self,
        env: Any,
        robot_model: RobotModel,
        joints: tuple[str, ...],
        base: str,
        ignored: Collection[str],
        margin: float,
    ) -> None:
        self._env, self._arguments, self._options = env, (robot_model, joints, base), (ignored, margin)
        self._handles: MujocoHandles = (None, None)
        self._update()

    @property
    def arm(self) -> MujocoArm:
        self._update()
        return self._arm

    @property
    def obstacles(self) -> MujocoObstacles:
        self._update()
        return self._obstacles

    def _update(self) -> None:
        model, data = mujoco_handles(self._env)
        if self._handles[0] is model and self._handles[1] is data:
            return
        robot_model, joints, base = self._arguments
        ignored, margin = self._options
        self._arm = MujocoArm(model, data, robot_model, joints, base)
        self._obstacles = MujocoObstacles(self._arm, ignored=ignored, margin=margin)
        self._handles = (model, data)


_ACCESS: tuple[tuple[str, Callable[[Any], MujocoHandles]], ...] = (
    ("Gymnasium, gymnasium-robotics, metaworld", lambda env: (env.model, env.data)),
    ("robosuite", lambda env: (env.sim.model._model, env.sim.data._data)),
    ("dm_control", lambda env: (env.physics.model.ptr, env.physics.data.ptr)),
    ("gym-aloha", lambda env: (env._env.physics.model.ptr, env._env.physics.data.ptr)),
)
"""Where each suite keeps its simulation."""


def mujoco_handles(env: Any) -> MujocoHandles:
    """`MjModel` and `MjData` of the unwrapped environment; raises `ConfigurationError` without a MuJoCo simulation."""
    inner = getattr(env, "unwrapped", env)
    for _, access in _ACCESS:
        try:
            model, data = access(inner)
        except AttributeError:
            continue
        if hasattr(model, "geom_type") and isinstance(getattr(data, "qpos", None), np.ndarray):
            return model, data
    known = ", ".join(suite for suite, _ in _ACCESS)
    raise ConfigurationError.stating(
        f"The environment {type(inner).__name__} has no MuJoCo simulation where these suites have it: {known}.",
        fix="Give its model and data as the attributes `model` and `data` of the unwrapped environment.",
    )
