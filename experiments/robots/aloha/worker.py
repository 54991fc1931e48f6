"""The process in gym-aloha's environment: one line of parameters in (JSON), one line with the row of an episode out.

`aloha_process.py` runs it as `python -m experiments.robots.aloha.worker`.
"""

from __future__ import annotations

import json
import sys

from experiments.robots.aloha.episode import run_episode


def main() -> None:
    """Answer every line of stdin until it ends."""
    answers, sys.stdout = sys.stdout, sys.stderr  # stdout carries nothing but rows
    for line in sys.stdin:
        answers.write(json.dumps(run_episode(json.loads(line))) + "\n")
        answers.flush()


if __name__ == "__main__":
    import gym_aloha  # noqa: F401  # pyright: ignore[reportMissingImports]  # registers the environments

    main()
