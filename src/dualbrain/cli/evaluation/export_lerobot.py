"""dualbrain export lerobot: recorded runs as a LeRobotDataset v3."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import msgspec
from cyclopts import Parameter
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from dualbrain.cli.common.console import StderrConsole, print_message, print_result
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.core.text import count_noun
from dualbrain.errors import UsageError

MAX_FPS = 1000


def export_lerobot(
    *runs: Path,
    out: Path,
    fps: int = 30,
    action: Literal["velocity", "position"] = "velocity",
    task: str = "",
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Write recorded runs as one LeRobotDataset v3, which LeRobot 0.6 loads and trains from.

    Every run is an episode. A frame has `observation.state` (q), `action` (the control that the filter let through),
    `dualbrain.u_nom` (the nominal control), `dualbrain.delta`, `dualbrain.h_min`, `dualbrain.status`, and
    `intervention`: true where the filter changed the control. The task is the instruction; `tools` in meta/info.json
    are the skills with their parameters. Frame k is the tick nearest to k / fps; over the ticks up to the next frame,
    delta is the maximum, h_min the minimum and status the worst, so that no intervention is lost between two frames.

    Example: `dualbrain export lerobot runs/a runs/b --out data/cubes`, then in Python
    `LeRobotDataset("me/cubes", root="data/cubes")`. Failed runs are exported too: name only those to learn from.

    Parameters
    ----------
    runs
        Run folders, as `dualbrain run --out DIR` writes them, or recordings (.mcap), all of the same robot.
    out
        A new folder for the dataset. It is complete or absent.
    fps
        Frames per second, at most the rate of the ticks (1000 for the packaged arms).
    action
        velocity: the executed joint velocities of the tick [rad/s]. position: where the executed control takes the
        joints until the next frame, q + Σ u Δt [rad], for policies that command joint positions.
    task
        The task of runs without an instruction.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.runtime.data_collection.lerobot.export import export_runs

    if not runs:
        fix = "For example: dualbrain export lerobot runs/a --out data/cubes"
        raise UsageError("RUN", got="nothing", allowed="at least one run folder", fix=fix)
    if not 1 <= fps <= MAX_FPS:
        raise UsageError("--fps", got=fps, allowed=f"1 to {MAX_FPS}")
    console = StderrConsole()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        reading = bar.add_task("reading runs", total=len(runs))
        episodes = export_runs(
            runs, out, fps=fps, action=action, task=task, on_run=lambda done: bar.update(reading, completed=done)
        )
    frames = sum(episode.frames for episode in episodes)
    changed = sum(episode.interventions for episode in episodes)
    if json:
        found = {"out": str(out), "fps": fps, "action": action, "frames": frames, "episodes": episodes}
        print_result(msgspec.json.encode(found).decode())
    for episode in episodes:
        outcome = episode.outcome or "outcome unknown"
        line = (
            f"{episode.run}: {episode.frames} frames, {episode.interventions} interventions, {outcome}: {episode.task}"
        )
        console.print(line, markup=False)
    count = count_noun(len(episodes), "episode")
    print_message(f"{out}: {count}, {frames} frames, {changed} of them interventions")
    return ExitCode.SUCCESS
