"""The process in gym-aloha's environment: `python -m experiments.robots.aloha.worker`."""

from __future__ import annotations

from importlib import metadata

from experiments.engine.worker_process import serve
from experiments.robots.aloha.episode import run_episode


def main() -> None:
    """Answer requests until the input ends."""
    serve({name: metadata.version(name) for name in ("gym-aloha", "mujoco", "dm_control", "numpy")}, run_episode)


if __name__ == "__main__":
    import gym_aloha  # noqa: F401  # pyright: ignore[reportMissingImports]  # registers the environments

    main()
