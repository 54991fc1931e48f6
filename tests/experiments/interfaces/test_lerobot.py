"""LeRobot's environment, and exported datasets in LeRobot itself (slow, only where the environment was created)."""

import ast
import dataclasses
import json
import subprocess

import numpy as np
import pytest

from dualbrain.errors import MissingDependencyError
from dualbrain.runtime.data_collection.lerobot.export import export_runs
from dualbrain.runtime.data_collection.lerobot.frames import sample_frames
from dualbrain.runtime.data_collection.lerobot.recorded_run import read_run
from experiments.interfaces.lerobot import virtual_environment
from experiments.interfaces.lerobot.type_parameter_syntax import lower_type_parameters
from experiments.interfaces.lerobot.virtual_environment import ENVIRONMENT, HERE
from tests.runtime.data_collection.lerobot.sample_runs import sample_rows, write_run
from tests.support.completed_run import completed_run

TRAINING_STEPS = 20
SOURCE = '''"""A module."""
from __future__ import annotations

import typing
from collections.abc import Callable

type Alias = str | int
type = 3


class Plain:
    type: int = 0


class Alone[T]:
    def method[U: (int, str)](self, value: U) -> T: ...


class Derived[A, B: dict[str, int]](Plain):
    pass


class Empty[A]():
    pass


async def task[T: Plain](value: T, other: dict[str, int] | None = None) -> T:
    text = "class X[T]: type Y = 3"
    return value
'''


def test_the_syntax_of_type_parameters_is_translated():
    lowered = lower_type_parameters(SOURCE)
    space = {"__name__": "lowered"}
    exec(compile(lowered, "lowered", "exec"), space)
    assert space["Alias"] == str | int
    assert space["type"] == 3
    assert [str(one) for one in space["Derived"].__parameters__] == ["~A", "~B"]
    assert issubclass(space["Derived"], space["Plain"])
    assert space["Alone"][int]
    assert space["Empty"][int]
    assert 'text = "class X[T]: type Y = 3"' in lowered
    functions = [node.name for node in ast.walk(ast.parse(lowered)) if isinstance(node, ast.AsyncFunctionDef)]
    assert functions == ["task"]


def test_a_module_without_type_parameters_is_unchanged():
    for path in HERE.glob("*.py"):
        source = path.read_text("utf-8")
        assert lower_type_parameters(source) == source


def test_a_missing_or_outdated_environment_names_the_command(tmp_path):
    moved = dataclasses.replace(ENVIRONMENT, folder=tmp_path)
    with pytest.raises(MissingDependencyError, match=ENVIRONMENT.command):
        moved.interpreter()
    (tmp_path / "venv" / "bin").mkdir(parents=True)
    (tmp_path / "venv" / "bin" / "python").touch()
    (tmp_path / "made-from").write_text("another")
    with pytest.raises(MissingDependencyError, match=ENVIRONMENT.command):
        moved.interpreter()
    (tmp_path / "made-from").write_text(ENVIRONMENT.digest)
    assert moved.interpreter() == tmp_path / "venv" / "bin" / "python"
    assert all("==" in package for package in ENVIRONMENT.packages)


@pytest.fixture
def lerobot():
    """The interpreter of LeRobot's environment."""
    try:
        return ENVIRONMENT.interpreter()
    except MissingDependencyError as missing:
        pytest.skip(str(missing))


def read_with_lerobot(python, folder, out, steps=0):
    """The report and the columns of `read_dataset`."""
    out.mkdir()
    done = subprocess.run(
        [str(python), str(HERE / "read_dataset.py"), str(folder), str(out), str(steps)],
        env=virtual_environment.process_environment(out),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads((out / "report.json").read_text()), dict(np.load(out / "frames.npz"))


def check_columns(columns, runs, fps, action):
    """The columns that LeRobot returns have the values of the recordings, bit for bit."""
    parts = [
        sample_frames(run.trace, fps, action=action, period=run.robot_model.period, path=run.recording) for run in runs
    ]
    names = {"observation.state": "q", "action": "action", "intervention": "intervention"}
    names |= {f"dualbrain.{one}": one for one in ("u_nom", "delta", "h_min", "status", "opening")}
    for column, name in names.items():
        wanted = np.concatenate([getattr(part, name) for part in parts])
        assert columns[column].dtype == wanted.dtype, column
        assert columns[column].tobytes() == wanted.tobytes(), column
    return [len(part) for part in parts]


@pytest.mark.slow
def test_a_run_of_the_command_line_reloads_and_an_act_trains_from_it(lerobot, tmp_path_factory, tmp_path):
    folder, *_ = completed_run(tmp_path_factory)
    runs = [folder / "run", write_run(tmp_path / "other", sample_rows(ticks=2000), instruction="stack")]
    export_runs(runs, tmp_path / "out")
    report, columns = read_with_lerobot(lerobot, tmp_path / "out", tmp_path / "read", TRAINING_STEPS)
    recorded = [read_run(run) for run in runs]
    assert report["lengths"] == check_columns(columns, recorded, 30, "velocity")
    assert report["tasks"] == report["frame_tasks"] == [run.instruction for run in recorded]
    info = json.loads((tmp_path / "out/meta/info.json").read_text())
    assert (report["tools"], report["robot_type"], report["fps"]) == (info["tools"], "panda", 30)
    assert report["episode_statistics_difference"] <= 1e-6
    assert report["dataset_statistics_difference"] <= 1e-6
    losses = report["losses"]
    assert len(losses) == TRAINING_STEPS
    assert np.isfinite(losses).all()
    assert np.mean(losses[-5:]) < 0.5 * losses[0]


@pytest.mark.slow
def test_positions_at_every_tick_reload(lerobot, tmp_path):
    runs = [write_run(tmp_path / f"run{seed}", sample_rows(ticks=1500, seed=seed)) for seed in range(3)]
    export_runs(runs, tmp_path / "out", fps=1000, action="position")
    report, columns = read_with_lerobot(lerobot, tmp_path / "out", tmp_path / "read")
    assert report["lengths"] == check_columns(columns, [read_run(run) for run in runs], 1000, "position")
    assert max(report["episode_statistics_difference"], report["dataset_statistics_difference"]) <= 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["base", "mobile_panda"])
def test_mobile_robots_and_episodes_of_one_frame_reload(lerobot, tmp_path, robot):
    runs = [write_run(tmp_path / f"run{ticks}", sample_rows(robot, ticks=ticks), robot=robot) for ticks in (1, 700)]
    export_runs(runs, tmp_path / "out")
    report, columns = read_with_lerobot(lerobot, tmp_path / "out", tmp_path / "read")
    assert report["lengths"] == check_columns(columns, [read_run(run) for run in runs], 30, "velocity") == [1, 21]
    assert max(report["episode_statistics_difference"], report["dataset_statistics_difference"]) <= 1e-6
