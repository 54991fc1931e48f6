"""dualbrain demo: the main job in one command."""

from __future__ import annotations

from dataclasses import replace

DEMO_PLANNER = "starter-135m"
"""Small, and comes with dualbrain but for what it sits on (98 MB). It knows a Panda at a table."""


def demo(
    instruction: str = "put the red cube in the bowl",
    /,
    *,
    planner: str = DEMO_PLANNER,
    headless: bool = False,
    scene: str = "8",
) -> int:
    """A person's forearm crosses the table while the arm does what it was told. Exits 0 only on real success.

    Parameters
    ----------
    instruction
        What to do, in words.
    planner
        Name from `dualbrain models list`, an adapter, or the URL of an OpenAI-compatible server.
    headless
        No live view; then time runs as fast as it can, in one process.
    scene
        Which world; in scene 8 a forearm crosses the path, and the filter has to bend it.
    """
    from dualbrain.cli.run.execution import RunView, default_config, execute_run

    shown = not headless
    config = replace(default_config(instruction), scene=scene, planner=planner, measured=shown)
    return execute_run(config, RunView(live_view=shown, keep_open=shown, real_time=shown))
