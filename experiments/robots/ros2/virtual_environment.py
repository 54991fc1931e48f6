"""The environment of rclpy, build/ros2/venv, created from requirements.txt.

Run: python -m experiments.robots.ros2.virtual_environment

It installs rclpy 9.1.2 (ROS 2 Rolling) with Fast DDS from wheels, without dualbrain and without a ROS installation.
"""

from __future__ import annotations

import os
from pathlib import Path

from experiments.engine.virtual_environment import BUILD, VirtualEnvironment, run_creation

HERE = Path(__file__).resolve().parent
REQUIREMENTS, PEER, PROFILE = HERE / "requirements.txt", HERE / "rclpy_peer.py", HERE / "fastdds_profile.xml"
ENVIRONMENT = VirtualEnvironment(
    title="rclpy",
    folder=BUILD / "ros2",
    command="python -m experiments.robots.ros2.virtual_environment",
    sources=(REQUIREMENTS,),
)


def peer_command(*arguments: str) -> list[str]:
    """The command of the peer. Raises `MissingDependencyError` unless the environment exists."""
    return [str(ENVIRONMENT.interpreter()), str(PEER), *arguments]


def peer_variables(domain: int) -> dict[str, str]:
    """The variables of a process of the environment, in a DDS `domain`.

    Type propagation is off: Fast DDS would compare the names inside the types, which differ between implementations.
    """
    return {**os.environ, "ROS_DOMAIN_ID": str(domain), "FASTDDS_DEFAULT_PROFILES_FILE": str(PROFILE)}


def create() -> Path:
    """Create the environment if it does not exist; returns its interpreter.

    Raises:
        MissingDependencyError: pip could not install it; the output of pip is on stderr.
    """
    wheels = ("--only-binary", ":all:", "--no-binary", "empy")
    return ENVIRONMENT.create(lambda: ENVIRONMENT.pip("install", *wheels, "-r", str(REQUIREMENTS)))


if __name__ == "__main__":
    run_creation(create)
