"""The filter in front of the Fetch arm of gymnasium-robotics; see `mocap_control.py` for the guarantee.

The base of the arm is the torso, whose pose is read before every action: its joint starts below its lower limit, and
the simulation lifts it by about 3 mm/s in spite of a damping of 10⁷. That velocity is not in the rows of the filter.
The mobile base is an obstacle.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from dualbrain.robots.model import RobotModel
from dualbrain.safety.integration.gym_env import FilteredEnv
from dualbrain.simulation.environments.mocap.arm_model import ArmLimits
from dualbrain.simulation.environments.mocap.mocap_control import MocapControl, guard_mocap_env, mocap_robot

JOINTS = ("shoulder_pan", "shoulder_lift", "upperarm_roll", "elbow_flex", "forearm_roll", "wrist_flex", "wrist_roll")
CONTROL = MocapControl(
    tool="robot0:gripper_link",
    base="robot0:torso_lift_link",
    joints=tuple(f"robot0:{name}_joint" for name in JOINTS),
    scale=0.05,
    reference="tool",
    rotation=(1.0, 0.0, 1.0, 0.0),
    has_held_base=True,
)
BODIES_AT_TORSO = ("robot0:torso_fixed_link", "robot0:estop_link", "robot0:laser_link")
"""Bodies of the robot around its torso, within the box around each of which the shoulder moves."""
LIMITS = ArmLimits(velocity=1.0, acceleration=12.0, tool_speed=1.0, period=0.01)
"""Site policy; the period of the filter is a quarter of a step of the environment."""


def guard_fetch(
    env: Any,
    robot_model: RobotModel | None = None,
    *,
    ignored: Collection[str] = ("object0",),
    deviation: float = 0.02,
    arm_deviation: float = 0.06,
) -> FilteredEnv:
    """A Fetch environment with its actions replaced by the closest safe ones; the gripper passes unchanged.

    `robot_model` is by default `fetch_robot(env)`; one step of the environment, 40 ms, must be a multiple of its
    period. Bodies in `ignored` are no obstacles. `deviation` and
    `arm_deviation` [m] are the bounds of `guard_mocap_env`, whose errors are raised.
    """
    model = fetch_robot(env) if robot_model is None else robot_model
    own = (*ignored, *BODIES_AT_TORSO)
    return guard_mocap_env(env, model, CONTROL, ignored=own, deviation=deviation, arm_deviation=arm_deviation)


def fetch_robot(env: Any, limits: ArmLimits = LIMITS) -> RobotModel:
    """The robot model of the Fetch arm in `env`, which is reset once, made in seconds from its MuJoCo model.

    It is not packaged: the meshes of Fetch Robotics have the licence CC BY-NC-SA 4.0. `make_arm_model` states errors.
    """
    return mocap_robot(env, CONTROL, "fetch", limits)
