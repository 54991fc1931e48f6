"""The virtual environment of gym-aloha, build/gym_aloha/venv, created from requirements.txt.

Run: python -m experiments.robots.aloha.virtual_environment

It installs gym-aloha 0.1.5 and MuJoCo 3.8.1 with their dependencies. Everything else, dualbrain included, it takes from
the environment that creates it: packages of both are taken from requirements.txt.
"""

from __future__ import annotations

from pathlib import Path

from experiments.engine.virtual_environment import BUILD, PRESENT, VirtualEnvironment, run_creation

REQUIREMENTS = Path(__file__).resolve().parent / "requirements.txt"
ENVIRONMENT = VirtualEnvironment(
    title="gym-aloha",
    folder=BUILD / "gym_aloha",
    command="python -m experiments.robots.aloha.virtual_environment",
    sources=(REQUIREMENTS,),
    version=PRESENT,
)


def create() -> Path:
    """Create the environment if it does not exist; returns its interpreter.

    Raises:
        MissingDependencyError: pip could not install it; the output of pip is on stderr.
    """
    return ENVIRONMENT.create(_install)


def _install() -> None:
    ENVIRONMENT.pip("install", "-r", str(REQUIREMENTS))
    ENVIRONMENT.share_present_packages()


if __name__ == "__main__":
    run_creation(create)
