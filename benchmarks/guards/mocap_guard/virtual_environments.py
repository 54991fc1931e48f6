"""The virtual environments of both suites, build/mocap_guard_*/venv: their versions of MuJoCo exclude each other.

Run: python -m benchmarks.guards.mocap_guard.virtual_environments

Everything that a suite does not install, dualbrain included, is taken from the environment that creates these.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from experiments.engine.virtual_environment import BUILD, PRESENT, VirtualEnvironment, run_creation

SUITES = {"fetch": "gymnasium-robotics", "metaworld": "metaworld"}
"""Names of the suites in this experiment, and of their packages."""
ENVIRONMENTS = {
    suite: VirtualEnvironment(
        title=package,
        folder=BUILD / f"mocap_guard_{suite}",
        command="python -m benchmarks.guards.mocap_guard.virtual_environments",
        sources=(Path(__file__).resolve().with_name(f"requirements_{suite}.txt"),),
        version=PRESENT,
    )
    for suite, package in SUITES.items()
}


def create(suite: str) -> Path:
    """Create the environment of `suite` if it does not exist; returns its interpreter.

    Raises:
        MissingDependencyError: pip could not install it; the output of pip is on stderr.
    """
    return ENVIRONMENTS[suite].create(partial(_install, suite))


def _install(suite: str) -> None:
    environment = ENVIRONMENTS[suite]
    environment.pip("install", *environment.packages)
    environment.share_present_packages()


def _create_all() -> None:
    for suite in SUITES:
        create(suite)


if __name__ == "__main__":
    run_creation(_create_all)
