"""A recorded run as the exporter reads it: robot, instruction, names of the scene, frames, and its outcome."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from dualbrain.control.recording.channels import (
    EpisodeInfo,
    SceneSeen,
    Ticks,
    damaged_recording,
    read_recording,
    recording_state,
)
from dualbrain.control.recording.recorded_robot import recorded_robot
from dualbrain.control.recording.trace import Trace
from dualbrain.core.untrusted.bounded_file import FileRefusal, read_regular_file
from dualbrain.errors import DECODE_ERRORS, ConfigurationError
from dualbrain.robots.model import RobotModel

RECORDING, EPISODE = "episode.mcap", "episode.json"
MAX_EPISODE_BYTES = 64 << 20
"""Largest size of an episode.json [bytes]."""


class _SavedOutcome(msgspec.Struct):
    kind: str


class _SavedEpisode(msgspec.Struct):
    outcome: _SavedOutcome


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedRun:
    """A complete recording with at least one tick.

    `name` is that of the run folder, `recording` the path of its recording. `outcome` is the robot's own verdict from
    episode.json, None without that file. `graspable` and `receptive` are all names of its perceived scenes.
    """

    name: str
    recording: Path
    robot_model: RobotModel
    instruction: str
    outcome: str | None
    graspable: tuple[str, ...]
    receptive: tuple[str, ...]
    trace: Trace


@dataclass(slots=True, kw_only=True)
class _Messages:
    """The messages of a recording, collected in their order."""

    robot_model: RobotModel | None = None
    instruction: str = ""
    trace: Trace | None = None
    graspable: dict[str, None] = field(default_factory=dict)
    receptive: dict[str, None] = field(default_factory=dict)


def recording_path(run: Path) -> Path:
    """The recording of `run`, a run folder or a recording itself. Raises `ConfigurationError` if there is none."""
    path = run / RECORDING if run.is_dir() else run
    if isinstance(refusal := read_regular_file(path, 0), FileRefusal) and refusal.kind != "too large":
        fix = "Name the folder of a run, as `dualbrain run --out DIR` writes it, or its episode.mcap."
        problem = f"{run} is no recorded run: there is no {path}." if refusal.kind == "missing" else refusal.sentence
        raise ConfigurationError.stating(problem, fix=fix)
    return path


def read_run(run: Path) -> RecordedRun:
    """The recorded `run`, a run folder or a recording.

    Raises `ConfigurationError` if it is missing, damaged or incomplete, or has no tick, and `UnknownNameError` if it
    names a robot that is neither packaged nor in the recording.
    """
    path = recording_path(run)
    state = recording_state(path)
    if not state.complete:
        reason = state.problem or "messages were lost"
        raise ConfigurationError.stating(
            f"The recording {path} is incomplete: {reason}.", fix="Leave this run out, or record it again."
        )
    found = _collect(path)
    if found.robot_model is None:
        sentence = f"The file {path} has no /episode message."
        raise ConfigurationError.stating(sentence, fix="Name a recording that dualbrain wrote.")
    if found.trace is None or not len(found.trace):
        sentence = f"The recording {path} has no tick: the robot was not controlled in this run."
        raise ConfigurationError.stating(sentence, fix="Leave this run out.")
    return RecordedRun(
        name=path.resolve().parent.name,
        recording=path,
        robot_model=found.robot_model,
        instruction=found.instruction,
        outcome=_saved_outcome(path.with_name(EPISODE)),
        graspable=tuple(found.graspable),
        receptive=tuple(found.receptive),
        trace=found.trace,
    )


def _collect(path: Path) -> _Messages:
    found = _Messages()
    for message in read_recording(path):
        match message:
            case EpisodeInfo(_, data) if found.robot_model is None:
                try:
                    found.robot_model = recorded_robot(data)
                except (KeyError, msgspec.ValidationError) as error:
                    raise damaged_recording(path, error) from error
                found.instruction = str(data.get("instruction", ""))
            case SceneSeen(_, scene):
                found.graspable |= dict.fromkeys(scene.graspable)
                found.receptive |= dict.fromkeys(scene.receptive)
            case Ticks() if found.robot_model is not None:
                _extend(found, message, found.robot_model, path)
            case _:
                pass
    return found


def _extend(found: _Messages, ticks: Ticks, robot_model: RobotModel, path: Path) -> None:
    got, expected = (ticks.n, ticks.width or ticks.n), (robot_model.n, robot_model.nq)
    if got != expected:
        raise damaged_recording(path, f"ticks of {got[0]} joints for a robot of {expected[0]}")
    found.trace = found.trace or Trace(robot_model.n, robot_model.nq)
    found.trace.extend(ticks.rows())


def _saved_outcome(path: Path) -> str | None:
    data = read_regular_file(path, MAX_EPISODE_BYTES)
    if isinstance(data, FileRefusal):
        if data.kind == "missing":
            return None
        raise ConfigurationError.stating(data.sentence, fix=data.fix)
    try:
        return msgspec.json.decode(data, type=_SavedEpisode).outcome.kind
    except DECODE_ERRORS as error:
        sentence = f"The file {path} is no episode of dualbrain ({' '.join(str(error).split())[:120]})."
        raise ConfigurationError.stating(sentence, fix="Restore it, or leave this run out.") from error
