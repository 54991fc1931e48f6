"""The suite's virtual environment, build/robosuite/venv, created from requirements.txt.

Run: python -m experiments.robots.robosuite.virtual_environment

It installs robosuite 1.5.2, MuJoCo 3.3.7 and NumPy 1.26.4 with their dependencies (1.3 GB on disk), without dualbrain.
"""

from __future__ import annotations

from pathlib import Path

from experiments.engine.virtual_environment import BUILD, VirtualEnvironment, run_creation

REQUIREMENTS = Path(__file__).resolve().parent / "requirements.txt"
ENVIRONMENT = VirtualEnvironment(
    title="robosuite",
    folder=BUILD / "robosuite",
    command="python -m experiments.robots.robosuite.virtual_environment",
    sources=(REQUIREMENTS,),
)


def create() -> Path:
    """Create the environment if it does not exist; returns its interpreter.

    Raises:
        MissingDependencyError: pip could not install it; the output of pip is on stderr.
    """
    return ENVIRONMENT.create(lambda: ENVIRONMENT.pip("install", "-r", str(REQUIREMENTS)))


if __name__ == "__main__":
    run_creation(create)
