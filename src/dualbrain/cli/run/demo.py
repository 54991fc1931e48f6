"""dualbrain demo: the main example in one command."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from dualbrain.cli.common.console import StderrConsole
from dualbrain.cli.common.spinner import Spinner
from dualbrain.planner.registry import PACKAGED_PLANNER

DEMO_TRIES = 3
"""Contracts that may be executed; a busy machine ends one of them now and then."""


def demo(
    instruction: str = "put the red cube in the bowl",
    /,
    *,
    planner: str = PACKAGED_PLANNER,
    headless: bool = False,
    scene: str = "8",
    out: Path | None = None,
) -> int:
    """Run a task while a person's forearm crosses the table. Exit code 0 only if the simulator confirms the success.

    Up to three contracts are tried: after a failure, and after a stop because this machine was too busy for a robot in
    real time.

    Parameters
    ----------
    instruction
        The task in words (English).
    planner
        A name from `dualbrain models list`, an adapter, or the URL of an OpenAI-compatible server.
    headless
        Do not open the live view; the simulation then runs in one process, as fast as possible.
    scene
        A number, FAMILY:SEED or a scene file. In scene 8 a forearm crosses the path, and the filter changes the motion.
    out
        Folder of the run: configuration, scene, recording, report, images. Default: a new one in runs/.
    """
    with Spinner(StderrConsole(), "loading") as loading:
        from dualbrain.cli.run.execution import RunView, execute_run
        from dualbrain.runtime.config import default_config

        shown = not headless
        config = default_config(instruction, out=out)
        config = replace(config, scene=scene, planner=planner, tries=DEMO_TRIES, retry_when_busy=True, measured=shown)
        return execute_run(config, RunView(live_view=shown, keep_open=shown, real_time=shown), loading)
