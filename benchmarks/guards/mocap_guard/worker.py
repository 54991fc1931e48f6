"""The process in the environment of one suite: `python -m benchmarks.guards.mocap_guard.worker SUITE`."""

from __future__ import annotations

import sys
from importlib import metadata

from benchmarks.guards.mocap_guard.episode import run_episode
from benchmarks.guards.mocap_guard.virtual_environments import SUITES
from experiments.engine.worker_process import serve


def main() -> None:
    """Answer requests until the input ends."""
    packages = (SUITES[sys.argv[1]], "mujoco", "numpy")
    serve({name: metadata.version(name) for name in packages}, run_episode)


if __name__ == "__main__":
    main()
