"""LeRobot's commands and its asynchronous client end in the guard (slow, only where its environment was created)."""

import ast
import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import numpy as np
import pytest

from dualbrain import __version__
from dualbrain.core.geometry.shapes import HalfSpace
from dualbrain.errors import MissingDependencyError
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.integration.servo_bus.servo_settings import ServoSettings
from experiments.interfaces.lerobot.virtual_environment import ENVIRONMENT, HERE, process_environment

ROOT = Path(__file__).resolve().parents[3]
PLUGINS = (ROOT / "integrations" / "lerobot", HERE / "recording_servos")
SO101 = load_robot("so101")
KEYS = [f"{joint.name}.pos" for joint in SO101.joints]
THREAD = "dualbrain-servo-bus"
TIMEOUT = 240.0


@pytest.fixture(scope="module")
def lerobot(tmp_path_factory):
    """A function that runs LeRobot's Python with the plugins, which are installed as pip installs them."""
    try:
        python = ENVIRONMENT.interpreter()
    except MissingDependencyError as missing:
        pytest.skip(str(missing))
    folder = tmp_path_factory.mktemp("plugins")
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--target", str(folder)]
    sources = [_copy(plugin, tmp_path_factory.mktemp("source")) for plugin in PLUGINS]
    done = subprocess.run(
        [sys.executable, "-m", "pip", "install", *options, *map(str, sources)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    names = {file.parent.name for file in folder.glob("*.dist-info/METADATA")}
    assert any(name.startswith("lerobot_robot_dualbrain-") for name in names)
    home = tmp_path_factory.mktemp("home")
    environment = process_environment(home) | {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT / "src")])}

    def start(*arguments):
        return subprocess.Popen(
            [str(python), *map(str, arguments)],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            cwd=home,
        )

    return start


def _copy(plugin, folder):
    """The sources of a plugin without what a build leaves behind."""
    for file in plugin.rglob("*"):
        if file.suffix in (".py", ".toml", ".md") and "build" not in file.parts:
            target = folder / file.relative_to(plugin)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(file.read_bytes())
    return folder


def finish(process, timeout=TIMEOUT):
    """Wait for the end of a process, whose output is shown if it failed."""
    output, _ = process.communicate(timeout=timeout)
    assert process.returncode == 0, output[-4000:]
    return output


def robot_options(log):
    return [
        "--robot.type=dualbrain_guarded",
        "--robot.units=degrees",
        "--robot.mark_interventions=true",
        f"--robot.inner={{type: recording_servos, log: {log}}}",
    ]


def check_commands(log, least):
    """Every command came from the guard: in small steps, by its thread, and above the table."""
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert len(lines) > least
    assert {line["thread"] for line in lines} == {THREAD}
    path = np.radians([[line["values"][key] for key in KEYS] for line in lines])
    speed = np.array([joint.velocity.value for joint in SO101.joints])
    assert (np.abs(np.diff(path, axis=0)) <= 1.01 * SO101.period * speed).all()
    safety = SafetyFilter(SO101, obstacles=[Obstacle("table", HalfSpace())])
    for q in path[::10]:
        result = safety(q, np.zeros(5), np.zeros(5), 0.0)
        safety.reset()
        assert result.h_min > 0.0
    return path


def test_lerobot_can_discover_the_distribution():
    project = tomllib.loads((PLUGINS[0] / "pyproject.toml").read_text())
    name = project["project"]["name"]
    assert name.startswith("lerobot_robot_")  # LeRobot looks for underscores, and imports a module of the same name
    assert project["tool"]["setuptools"]["packages"] == [name]
    assert (PLUGINS[0] / name / "__init__.py").is_file()
    assert project["project"]["entry-points"]["dualbrain.integrations"] == {"lerobot": f"{name}.connector:connector"}
    tree = ast.parse((PLUGINS[0] / name / "connector.py").read_text())
    assert "connector" in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    assert project["project"]["version"] == __version__
    assert project["project"]["license"] == "Apache-2.0"


def test_the_guarded_robot_has_every_setting_and_the_page_describes_every_option():
    name = "lerobot_robot_dualbrain"
    tree = ast.parse((PLUGINS[0] / name / "config_dualbrain_guarded.py").read_text())
    (config,) = (node for node in tree.body if isinstance(node, ast.ClassDef))
    options = {node.target.id for node in config.body if isinstance(node, ast.AnnAssign)}
    settings = {field.name for field in dataclasses.fields(ServoSettings)}
    assert settings < options
    page = (ROOT / "docs" / "how-to" / "guard" / "lerobot.md").read_text()
    assert [option for option in sorted(options) if f"`{option}`" not in page] == []
    assert page.count("\n") <= 40
    (step,) = (
        node
        for node in ast.parse((PLUGINS[0] / name / "safety_filter_step.py").read_text()).body
        if isinstance(node, ast.ClassDef)
    )
    assert {node.target.id for node in step.body if isinstance(node, ast.AnnAssign)} == settings


@pytest.mark.slow
def test_the_guarded_robot_and_the_processor_step_through_the_classes_of_lerobot(lerobot, tmp_path):
    assert "checked" in finish(lerobot(HERE / "check_guarded_robot.py", tmp_path))


@pytest.mark.slow
def test_record_and_replay_end_in_the_guard(lerobot, tmp_path):
    recorded, replayed, dataset = tmp_path / "record.jsonl", tmp_path / "replay.jsonl", tmp_path / "dataset"
    seconds = 4
    finish(
        lerobot(
            *("-m", "lerobot.scripts.lerobot_record", *robot_options(recorded)),
            *("--teleop.type=careless_operator", "--dataset.repo_id=local/guarded", f"--dataset.root={dataset}"),
            *(f"--dataset.episode_time_s={seconds}", "--dataset.reset_time_s=0", "--dataset.num_episodes=1"),
            *("--dataset.single_task=press the table", "--dataset.push_to_hub=false", "--dataset.video=false"),
            *("--dataset.fps=30", "--play_sounds=false"),
        )
    )
    check_commands(recorded, 50 * seconds)
    info = json.loads((dataset / "meta" / "info.json").read_text())
    assert info["features"]["observation.state"]["names"][-1] == "intervention"
    stats = json.loads((dataset / "meta" / "stats.json").read_text())
    assert stats["observation.state"]["max"][-1] == 1.0
    assert stats["observation.state"]["min"][-1] == 0.0
    assert stats["action"]["max"][1] > 55.0  # the operator commanded the table
    finish(
        lerobot(
            *("-m", "lerobot.scripts.lerobot_replay", *robot_options(replayed)),
            *("--dataset.repo_id=local/guarded", f"--dataset.root={dataset}", "--dataset.episode=0"),
            "--play_sounds=false",
        )
    )
    check_commands(replayed, 50 * seconds)


@pytest.mark.slow
def test_the_asynchronous_client_ends_in_the_guard(lerobot, tmp_path):
    log, port = tmp_path / "async.jsonl", tmp_path / "port"
    server = lerobot(HERE / "chunk_server.py", port)
    client = None
    try:
        wait_for(port.exists, server)
        client = lerobot(
            *("-m", "lerobot.async_inference.robot_client", *robot_options(log)),
            *(f"--server_address=127.0.0.1:{port.read_text()}", "--policy_type=act"),
            *("--pretrained_name_or_path=none", "--actions_per_chunk=15", "--fps=30", "--task=press the table"),
        )
        wait_for(lambda: log.exists() and log.read_text().count("\n") > 600, client)
        client.send_signal(signal.SIGINT)
        client.communicate(timeout=60)
    finally:
        for process in (server, client):
            if process is not None and process.poll() is None:
                process.kill()
                process.communicate()
    check_commands(log, 600)


def wait_for(condition, process):
    """Wait until `condition` holds while `process` runs."""
    deadline = time.monotonic() + TIMEOUT
    while not condition():
        assert process.poll() is None, process.communicate()[0][-4000:]
        assert time.monotonic() < deadline
        time.sleep(0.2)
