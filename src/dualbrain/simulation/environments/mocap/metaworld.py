"""The filter in front of metaworld's Sawyer; `mocap_control.py` states the guarantee."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from dualbrain.robots.model import RobotModel
from dualbrain.safety.integration.gym_env import FilteredEnv
from dualbrain.simulation.environments.mocap.arm_model import ArmLimits
from dualbrain.simulation.environments.mocap.mocap_control import MocapControl, guard_mocap_env, mocap_robot

CONTROL = MocapControl(
    tool="hand",
    base="right_arm_base_link",
    joints=tuple(f"right_j{k}" for k in range(7)),
    scale=0.01,
    reference="mocap",
    rotation=(1.0, 0.0, 1.0, 0.0),
    limits=lambda env: (env.mocap_low, env.mocap_high),
)
LIMITS = ArmLimits(velocity=0.5, acceleration=12.0, tool_speed=1.0, period=0.00625)
"""Site policy; the period of the filter is half a step of the environment."""


def guard_metaworld(
    env: Any,
    robot_model: RobotModel | None = None,
    *,
    ignored: Collection[str] = ("obj",),
    deviation: float = 0.025,
    arm_deviation: float = 0.06,
) -> FilteredEnv:
    """A v3 environment of metaworld with its actions replaced by the closest safe ones; the gripper passes unchanged.

    `robot_model` is by default `metaworld_robot(env)`; one step of the environment, 12.5 ms, must be a multiple of its
    period. Bodies in `ignored` are no obstacles, by default the object of
    most tasks. `deviation` and `arm_deviation` [m] are the bounds of `guard_mocap_env`, whose errors are raised.
    """
    model = metaworld_robot(env) if robot_model is None else robot_model
    return guard_mocap_env(env, model, CONTROL, ignored=ignored, deviation=deviation, arm_deviation=arm_deviation)


def metaworld_robot(env: Any, limits: ArmLimits = LIMITS) -> RobotModel:
    """The robot model of the Sawyer arm in `env`, which is reset once, made in seconds from its MuJoCo model.

    `make_arm_model` states the errors.
    """
    return mocap_robot(env, CONTROL, "sawyer", limits)
