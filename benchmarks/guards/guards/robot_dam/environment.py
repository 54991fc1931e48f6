"""Creates the virtual environment of robot-dam below build/.

python -m benchmarks.guards.guards.robot_dam.environment
"""

from __future__ import annotations

from pathlib import Path

from experiments.engine.virtual_environment import BUILD, VirtualEnvironment, run_creation

OWN_PACKAGES = ("robot-dam", "dam-rs")
"""Installed without their dependencies."""
ENVIRONMENT = VirtualEnvironment(
    title="robot-dam",
    folder=BUILD / "robot_dam",
    command="python -m benchmarks.guards.guards.robot_dam.environment",
    sources=(Path(__file__).with_name("requirements.txt"),),
)


def install() -> None:
    """Install the pinned packages."""
    own = [package for package in ENVIRONMENT.packages if package.startswith(OWN_PACKAGES)]
    ENVIRONMENT.pip("install", "--only-binary", ":all:", *(p for p in ENVIRONMENT.packages if p not in own))
    ENVIRONMENT.pip("install", "--no-deps", *own)


if __name__ == "__main__":
    run_creation(lambda: ENVIRONMENT.create(install))
