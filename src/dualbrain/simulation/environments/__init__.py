"""Environments of others that simulate with MuJoCo: their geometry as obstacles, their arm behind the filter."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dualbrain.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dualbrain.simulation.environments.guarded_mujoco_env import guard_mujoco_env
    from dualbrain.simulation.environments.gym_aloha import guard_aloha
    from dualbrain.simulation.environments.mocap.arm_model import ArmLimits
    from dualbrain.simulation.environments.mocap.gymnasium_robotics import fetch_robot, guard_fetch
    from dualbrain.simulation.environments.mocap.metaworld import guard_metaworld, metaworld_robot
    from dualbrain.simulation.environments.mocap.mocap_control import MocapControl, guard_mocap_env
    from dualbrain.simulation.environments.mujoco_arm import MujocoArm
    from dualbrain.simulation.environments.mujoco_obstacles import MujocoObstacles
    from dualbrain.simulation.environments.robosuite import guard_robosuite, robosuite_robot

_MODULES = {
    "simulation.environments.gym_aloha": ("guard_aloha",),
    "simulation.environments.guarded_mujoco_env": ("guard_mujoco_env",),
    "simulation.environments.mocap.arm_model": ("ArmLimits",),
    "simulation.environments.mocap.gymnasium_robotics": ("fetch_robot", "guard_fetch"),
    "simulation.environments.mocap.metaworld": ("guard_metaworld", "metaworld_robot"),
    "simulation.environments.mocap.mocap_control": ("MocapControl", "guard_mocap_env"),
    "simulation.environments.mujoco_arm": ("MujocoArm",),
    "simulation.environments.mujoco_obstacles": ("MujocoObstacles",),
    "simulation.environments.robosuite": ("guard_robosuite", "robosuite_robot"),
}
"""Public names by the module that defines them."""

__all__ = [
    "ArmLimits",
    "MocapControl",
    "MujocoArm",
    "MujocoObstacles",
    "fetch_robot",
    "guard_aloha",
    "guard_fetch",
    "guard_metaworld",
    "guard_mocap_env",
    "guard_mujoco_env",
    "guard_robosuite",
    "metaworld_robot",
    "robosuite_robot",
]

__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
