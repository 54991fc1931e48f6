"""A configuration error ends a run before any motion: exit code 5, and a message with the problem and its remedy."""

import json
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from dualbrain.cli.main import run_command_line
from dualbrain.core import weights
from dualbrain.core.paths import cache_folder
from dualbrain.errors import ConfigurationError
from dualbrain.memory.embedding.text_encoder import ENCODER_WEIGHTS, TOKENIZER_WEIGHTS
from dualbrain.memory.ledger.ledger import Ledger
from dualbrain.runtime.run_folder import RUN_FILES
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.scene_spec import save_scene
from tests.stories.story_session import contract_text, hold_contract, run_config, run_session


@pytest.fixture
def run_command(tmp_path, monkeypatch, capsys):
    """Run a command in an empty folder with its own home; returns (exit code, stderr); stdout must be empty."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DUALBRAIN_HOME", str(tmp_path / "home"))
    (tmp_path / "pause.json").write_text(hold_contract())

    def run(*arguments):
        code = run_command_line([*arguments])
        out, err = capsys.readouterr()
        assert out == ""
        return code, " ".join(err.split())

    return run


def run_arguments(*changes):
    return ("run", "put the red cube in the bowl", "--contract", "pause.json", "--headless", *changes)


def has_no_run(folder):
    return not list(folder.rglob("episode.mcap")) and not list(folder.rglob("*.sqlite"))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--scene", "forarm:3"), "'forearm'"),
        (("--scene", "tabeltop"), "'tabletop'"),
        (("--scene", "tabletop:x"), "got 'tabletop:x', allowed: a number, FAMILY:SEED"),
        (("--scene", "not a scene"), "FAMILY:SEED"),
        (("--scene", "missing.json"), "missing.json"),
        (("--robot", "pandaa"), "'panda'"),
        (("--goal", "put the red cub in the blue bowl", "--scene", "bare:0"), "'red_cube'"),
        (("--goal", "dance"), "put THING in DESTINATION"),
        (("--out", "pause.json"), "pause.json"),
        (("--out", "pause.json/below"), "pause.json/below"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_a_wrong_name_or_file_is_reported(run_command, tmp_path, arguments, text):
    code, err = run_command(*run_arguments(*arguments))
    assert code == 5
    assert text in err
    assert has_no_run(tmp_path)


def test_a_missing_contract_file_is_reported(run_command, tmp_path):
    code, err = run_command("run", "--contract", "nope.json", "--headless")
    assert code == 5
    assert "nope.json" in err
    assert has_no_run(tmp_path)


def test_an_unknown_planner_is_reported_with_the_closest_name(run_command, tmp_path):
    code, err = run_command("run", "do it", "--planner", "qwen2.5-coder-1.5b-instrukt", "--headless")
    assert code == 5
    assert "Closest: 'qwen2.5-coder-1.5b-instruct'" in err
    assert has_no_run(tmp_path)


def test_a_run_without_instruction_and_contract_is_a_usage_error(run_command, tmp_path):
    code, err = run_command("run", "  ", "--headless")
    assert code == 2
    assert "dualbrain run" in err  # an example
    assert has_no_run(tmp_path)


# --- scene files --------------------------------------------------------------------------------------------------


def modified_scene(change):
    """The bare scene as JSON with `change` applied."""
    scene = json.loads(msgspec.json.encode(open_scene("bare:0")))
    change(scene)
    return msgspec.json.encode(scene)


SCENES = {
    "broken JSON": (b'{"robot": "panda", "things": [', "scene file"),
    "not text": (b"\xff\xfe\x00", "scene file"),
    "an unknown field": (modified_scene(lambda s: s.update(gravity=1.0)), "gravity"),
    "an unknown field inside": (modified_scene(lambda s: s["things"][0].update(sticky=True)), "sticky"),
    "a missing field": (modified_scene(lambda s: s["things"][0].pop("mass")), "mass"),
    "another schema version": (modified_scene(lambda s: s.update(schema_version=99)), "schema_version"),
    "a name twice": (modified_scene(lambda s: s["things"].append(s["things"][0])), "red_cube"),
    "no weight": (modified_scene(lambda s: s["things"][0].update(mass=0.0)), "mass"),
    "a wrong type": (modified_scene(lambda s: s["things"][0].update(position="there")), "position"),
    "an unknown shape": (modified_scene(lambda s: s["things"][0]["shape"].update(shape="torus")), "shape"),
    "a number beyond floats": (modified_scene(lambda s: None).replace(b'"seed":0', b'"seed":1e999'), "seed"),
}


@pytest.mark.parametrize("name", SCENES)
def test_an_invalid_scene_file_is_reported_with_field_and_path(run_command, tmp_path, name):
    data, field = SCENES[name]
    (tmp_path / "scene.json").write_bytes(data)
    code, err = run_command(*run_arguments("--scene", "scene.json"))
    assert code == 5
    assert field in err
    assert "scene.json" in err
    assert has_no_run(tmp_path)


def test_a_saved_scene_round_trips(tmp_path):
    save_scene(open_scene("tabletop:5"), tmp_path / "scene.json")
    assert open_scene(str(tmp_path / "scene.json")) == open_scene("tabletop:5")


# --- weights ------------------------------------------------------------------------------------------------------


def test_missing_weights_name_the_command_that_fetches_them(run_command, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    code, err = run_command(*run_arguments())
    assert code == 5
    assert f"dualbrain models fetch {ENCODER_WEIGHTS}" in err
    assert has_no_run(tmp_path)


def test_a_weight_file_with_one_wrong_bit_is_refused(run_command, tmp_path, monkeypatch):
    folder = tmp_path / "cache" / "dualbrain"
    folder.mkdir(parents=True)
    for name in (ENCODER_WEIGHTS, TOKENIZER_WEIGHTS):
        shutil.copy(weights.locate_weights(name, cache_folder()), folder)
    damaged = folder / weights.find_weight_file(TOKENIZER_WEIGHTS).filename
    data = bytearray(damaged.read_bytes())
    data[len(data) // 2] ^= 1
    damaged.write_bytes(data)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    code, err = run_command(*run_arguments())
    assert code == 5
    assert "SHA-256" in err
    assert f"dualbrain models fetch {TOKENIZER_WEIGHTS}" in err
    assert has_no_run(tmp_path)


# --- folders and the ledger ---------------------------------------------------------------------------------------


def test_a_folder_with_a_run_is_not_overwritten(tmp_path):
    story = run_session(run_config(tmp_path), hold_contract())
    before = {path.name: path.read_bytes() for path in story.config.out.iterdir()}
    sessions = []
    with pytest.raises(ConfigurationError, match="--out"):
        run_session(run_config(tmp_path), hold_contract(), before=sessions.append)
    assert sessions == []
    assert {path.name: path.read_bytes() for path in story.config.out.iterdir()} == before
    assert set(before) <= set(RUN_FILES)


def test_a_run_in_the_working_folder_has_the_name_of_that_folder(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert run_session(run_config(tmp_path, out=Path()), hold_contract()).episode.id == "here"


def test_a_ledger_that_another_process_writes_is_reported(run_command, tmp_path):
    ledger = Ledger(tmp_path / "taken.sqlite", holder="a long run", now=0.0)
    code, err = run_command(*run_arguments("--ledger", "taken.sqlite"))
    ledger.close()
    assert code == 5
    assert f"process {os.getpid()} (a long run)" in err
    assert "--ledger" in err


def test_a_damaged_ledger_is_reported_and_not_changed(run_command, tmp_path):
    path = tmp_path / "ledger.sqlite"
    path.write_bytes(b"SQLite format 3\x00" + b"\x07" * 5000)
    before = path.read_bytes()
    code, err = run_command(*run_arguments("--ledger", "ledger.sqlite"))
    assert code == 5
    assert "ledger" in err
    assert path.read_bytes() == before


# --- graphics and ports -------------------------------------------------------------------------------------------

CLI_PROGRAM = "import sys; from dualbrain.cli.main import run_command_line; sys.exit(run_command_line(sys.argv[1:]))"


def run_in_process(folder, *arguments, **environment):
    """Run a command in a separate process."""
    (folder / "pause.json").write_text(contract_text(("hold", {"duration": 0.5})))
    command = [sys.executable, "-c", CLI_PROGRAM, *arguments, "--ledger", "ledger.sqlite"]
    home = {"DUALBRAIN_HOME": str(folder), "COLUMNS": "500"}
    return subprocess.run(
        command, cwd=folder, env={**os.environ, **home, **environment}, capture_output=True, text=True, check=False
    )


def test_without_gl_the_run_works_and_reports_that_images_are_missing(tmp_path):
    gl = "bogus"
    done = run_in_process(tmp_path, *run_arguments("--scene", "bare:0", "--out", "run"), MUJOCO_GL=gl)
    assert "no images" in done.stderr
    assert gl in done.stderr
    assert "contract completed, instruction not carried out" in done.stderr  # by a hold
    assert done.returncode == 1  # which is no violation
    report = (tmp_path / "run" / "report.html").read_text()
    assert "data:image/jpeg" not in report
    assert {path.name for path in (tmp_path / "run").iterdir()} == set(RUN_FILES)


def test_a_port_in_use_is_reported_and_another_one_is_used(tmp_path):
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        port = busy.getsockname()[1]
        arguments = run_arguments("--scene", "bare:0", "--out", "run", "--port", str(port))
        with_view = [one for one in arguments if one != "--headless"]
        done = run_in_process(tmp_path, *with_view, MUJOCO_GL="disable")
    assert f"Port {port} is in use" in done.stderr
    assert "live view: http://127.0.0.1:" in done.stderr
    assert done.returncode == 1
