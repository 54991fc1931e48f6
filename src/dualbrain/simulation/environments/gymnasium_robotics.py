"""The filter in front of the Fetch arm of gymnasium-robotics; see `mocap_control.py` for the guarantee.

The base of the robot has sliding joints with a damping of 10¹¹ and the torso one of 10⁷, so both count as fixed.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from dualbrain.robots.model import RobotModel
from dualbrain.safety.integration.derating import derate
from dualbrain.safety.integration.gym_env import FilteredEnv
from dualbrain.simulation.environments.mocap_control import MocapControl, guard_mocap_env

JOINTS = ("shoulder_pan", "shoulder_lift", "upperarm_roll", "elbow_flex", "forearm_roll", "wrist_flex", "wrist_roll")
CONTROL = MocapControl(
    tool="robot0:gripper_link",
    base="robot0:base_link",
    joints=tuple(f"robot0:{name}_joint" for name in JOINTS),
    scale=0.05,
    reference="tool",
    rotation=(1.0, 0.0, 1.0, 0.0),
    has_held_base=True,
)
PERIOD, MAX_SPEED = 0.01, 0.5
"""Period of the filter [s], a quarter of a step of the environment, and velocity limit of every joint [rad/s]."""


def guard_fetch(
    env: Any, robot_model: RobotModel, *, ignored: Collection[str] = ("object0",), deviation: float = 0.02
) -> FilteredEnv:
    """A Fetch environment with its actions replaced by the closest safe ones; the gripper passes unchanged.

    `robot_model` is the arm of the suite, imported with the tool `robot0:gripper_link` and the torso locked at 0.
    Bodies in `ignored` are no obstacles. `deviation` [m] is the bound of `guard_mocap_env`, whose errors are raised.
    """
    slow = derate(robot_model, period=PERIOD, max_speed=MAX_SPEED)
    return guard_mocap_env(env, slow, CONTROL, ignored=ignored, deviation=deviation)
