"""Export of recorded runs as one LeRobotDataset v3: every run is an episode."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.schema import tool_schemas
from dualbrain.core.storage.arrow_package import import_arrow
from dualbrain.core.storage.atomic_files import atomic_folder
from dualbrain.core.text import storable_text
from dualbrain.errors import ConfigurationError
from dualbrain.robots.model import RobotModel
from dualbrain.runtime.data_collection.lerobot.dataset_folder import DatasetFolder
from dualbrain.runtime.data_collection.lerobot.features import configuration_names, dataset_features
from dualbrain.runtime.data_collection.lerobot.frames import ActionKind, Frames, sample_frames
from dualbrain.runtime.data_collection.lerobot.recorded_run import RecordedRun, read_run, recording_path
from dualbrain.skills.registry import skill_registry

MAX_FPS = 10_000


class ExportedEpisode(msgspec.Struct, frozen=True, kw_only=True):
    """One episode of the dataset: name of its run, task, outcome by the robot's own verdict, frames, interventions."""

    run: str
    task: str
    outcome: str | None
    frames: int
    interventions: int


@dataclass(frozen=True, slots=True, kw_only=True)
class _Episode:
    """A run without its ticks, which need much more memory than its frames."""

    summary: ExportedEpisode
    recording: Path
    robot_model: RobotModel
    names: SceneNames
    frames: Frames


def export_runs(
    runs: Sequence[Path],
    out: Path,
    *,
    fps: int = 30,
    action: ActionKind = "velocity",
    task: str = "",
    on_run: Callable[[int], None] = lambda done: None,
) -> list[ExportedEpisode]:
    """Write the recorded `runs` (run folders or recordings) to the folder `out`, at `fps` frames per second.

    The folder is complete or absent. `frames` states the rule of sampling and the two kinds of `action`. The task of an
    episode is the instruction of its run, or `task` if it has none. `on_run` is called with the number of runs read.

    Raises:
        ConfigurationError: `out` has files, a run is missing, damaged, incomplete, without a tick, without a task or
            listed twice, or the runs are of different robots. The message states the remedy.
        UnknownNameError: A recording names an unknown robot.
        MissingDependencyError: The package arro3-io or mcap is missing.
        FileWriteError: The folder cannot be written.
    """
    import_arrow()
    require_free(out)
    if not 1 <= fps <= MAX_FPS:
        raise ConfigurationError("--fps", got=fps, allowed=f"1 to {MAX_FPS}, and at most the rate of the ticks")
    _require_distinct(runs)
    episodes: list[_Episode] = []
    for done, run in enumerate(runs):
        on_run(done)
        episodes.append(_read_episode(read_run(run), fps, action, task))
        _require_same_robot(episodes[0], episodes[-1])
    on_run(len(runs))
    _write(episodes, out, fps, action)
    return [episode.summary for episode in episodes]


def require_free(out: Path) -> None:
    """Raise `ConfigurationError` if `out` is a file or a folder with files."""
    if out.is_dir() and not out.is_symlink() and not any(out.iterdir()):
        return
    if out.exists() or out.is_symlink():
        problem = f"{out} exists already and is no empty folder."
        raise ConfigurationError.stating(problem, fix="Name a new folder with --out, or delete this one.")


def _require_distinct(runs: Sequence[Path]) -> None:
    if not runs:
        raise ConfigurationError.stating("No run is named.", fix="Name at least one run folder.")
    seen: set[Path] = set()
    for run in runs:
        path = recording_path(run).resolve()
        if path in seen:
            raise ConfigurationError.stating(f"The run {run} is listed twice.", fix="Name it once.")
        seen.add(path)


def _read_episode(run: RecordedRun, fps: int, action: ActionKind, task: str) -> _Episode:
    if action == "position" and run.robot_model.is_mobile:
        fix = "Leave out --action position: the velocities of a base are exported."
        raise ConfigurationError.stating(f"The robot of {run.recording} has a mobile base.", fix=fix)
    chosen = storable_text(run.instruction.strip() or task.strip())
    if not chosen:
        sentence = f"The run {run.name} has no instruction, and LeRobot needs a task."
        raise ConfigurationError.stating(sentence, fix='Name one: --task "put the red cube in the bowl".')
    frames = sample_frames(run.trace, fps, action=action, period=run.robot_model.period, path=run.recording)
    count = int(frames.intervention.sum())
    summary = ExportedEpisode(run=run.name, task=chosen, outcome=run.outcome, frames=len(frames), interventions=count)
    return _Episode(
        summary=summary,
        recording=run.recording,
        robot_model=run.robot_model,
        names=SceneNames(run.graspable, run.receptive),
        frames=frames,
    )


def _require_same_robot(first: _Episode, other: _Episode) -> None:
    """The robots of two runs have the same name and joints; limits may differ, as those of a site file do."""
    if _identity(first.robot_model) != _identity(other.robot_model):
        names = [f"{one.recording} ({one.robot_model.name})" for one in (first, other)]
        sentence = f"The runs are of different robots: {names[0]} and {names[1]}."
        raise ConfigurationError.stating(sentence, fix="Export each robot into a dataset of its own.")


def _identity(robot_model: RobotModel) -> tuple[str, ...]:
    return (robot_model.name, *configuration_names(robot_model))


def _write(episodes: Sequence[_Episode], out: Path, fps: int, action: ActionKind) -> None:
    robot_model = episodes[0].robot_model
    has_opening = all(bool(np.isfinite(one.frames.opening).all()) for one in episodes)
    features = dataset_features(robot_model, action, has_opening=has_opening)
    names = SceneNames(
        _union([one.names.graspable for one in episodes]), _union([one.names.receptive for one in episodes])
    )
    with atomic_folder(out) as temporary:
        dataset = DatasetFolder(temporary, features, fps, robot_model.name)
        for episode in episodes:
            dataset.add_episode(episode.frames, episode.summary.task)
        dataset.finish(tool_schemas(skill_registry(robot_model), names))


def _union(groups: Sequence[Sequence[str]]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for group in groups for name in group))
