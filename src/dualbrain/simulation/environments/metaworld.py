"""The filter in front of metaworld's Sawyer; `mocap_control.py` states the guarantee."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from dualbrain.robots.model import RobotModel
from dualbrain.safety.integration.derating import derate
from dualbrain.safety.integration.gym_env import FilteredEnv
from dualbrain.simulation.environments.mocap_control import MocapControl, guard_mocap_env

CONTROL = MocapControl(
    tool="hand",
    base="right_arm_base_link",
    joints=tuple(f"right_j{k}" for k in range(7)),
    scale=0.01,
    reference="mocap",
    rotation=(1.0, 0.0, 1.0, 0.0),
    limits=lambda env: (env.mocap_low, env.mocap_high),
)
PERIOD, MAX_SPEED = 0.00625, 0.5
"""Period of the filter [s], half a step of the environment, and velocity limit of every joint [rad/s]."""


def guard_metaworld(
    env: Any, robot_model: RobotModel, *, ignored: Collection[str] = ("obj",), deviation: float = 0.035
) -> FilteredEnv:
    """A v3 environment of metaworld with its actions replaced by the closest safe ones; the gripper passes unchanged.

    `robot_model` is the Sawyer of metaworld, imported with the tool `hand`. Bodies in `ignored` are no obstacles, by
    default the object of most tasks. `deviation` [m] is the bound of `guard_mocap_env`, whose errors are raised.
    """
    slow = derate(robot_model, period=PERIOD, max_speed=MAX_SPEED)
    return guard_mocap_env(env, slow, CONTROL, ignored=ignored, deviation=deviation)
