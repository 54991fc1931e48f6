"""The commands that do not move anything: check, schema, replay, models, doctor, help."""

import inspect
import io
import json
import os
import sys
from pathlib import Path

import jsonschema
import pytest

from dualbrain.adaptation.adapters.card import read_adapter_card
from dualbrain.adaptation.adapters.compatibility import require_compatible
from dualbrain.adaptation.adapters.packaged import packaged_folder
from dualbrain.cli import doctor
from dualbrain.cli.adapters.explore import explore
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.evaluation.evaluate import evaluate
from dualbrain.cli.evaluation.export_lerobot import export_lerobot
from dualbrain.cli.evaluation.report import compare, report
from dualbrain.cli.run.demo import demo
from dualbrain.cli.run.run import run
from dualbrain.core.storage.verification_stamp import write_stamp
from dualbrain.core.weights import find_weight_file
from dualbrain.errors import MissingDependencyError
from dualbrain.grounding.vocabulary import load_skill_registry
from tests.stories.story_session import (
    GRASP,
    PLACE,
    contract_text,
    decline_contract,
    hold_contract,
    run_config,
    run_session,
)
from tests.support.completed_run import run_command as run_in_process

GOOD = contract_text(("grasp", GRASP), ("place", PLACE))


@pytest.fixture
def check(run_command, tmp_path):
    """`dualbrain check` on a text; returns (exit code, the printed object)."""

    def run(text, *more):
        (tmp_path / "contract.json").write_text(text)
        code, out, err = run_command("check", "contract.json", *more)
        assert err == ""
        return code, json.loads(out)

    return run


def test_check_accepts_with_0_and_reports_only_the_acceptance(check):
    assert check(GOOD, "--scene", "bare:0") == (ExitCode.SUCCESS, {"accepted": True})


@pytest.mark.parametrize(
    ("text", "stage", "pointer"),
    [
        ("{", "syntax", ""),
        (GOOD.replace("panda", "ur5e"), "authorization", "/context/robot"),
        (contract_text(("throw", {})), "authorization", "/action_sequence/0/skill"),
        (contract_text(("grasp", {**GRASP, "force": 900.0})), "envelope", "/action_sequence/0/params/force"),
        (contract_text(("grasp", {**GRASP, "object": "table"})), "envelope", "/action_sequence/0/params/object"),
        (contract_text(("place", PLACE)), "envelope", "/action_sequence/0/skill"),
    ],
)
def test_check_rejects_with_3_and_reports_the_position(check, text, stage, pointer):
    code, data = check(text, "--scene", "bare:0")
    assert code == ExitCode.REJECTED
    assert data.keys() == {"accepted", "stage", "pointer", "got", "allowed", "hint"}
    assert (data["accepted"], data["stage"], data["pointer"]) == (False, stage, pointer)


def test_check_of_a_file_that_is_not_there(run_command):
    code, out, err = run_command("check", "nope.json")
    assert (code, out) == (ExitCode.SETUP, "")
    assert "nope.json" in err


def test_check_reads_standard_input(run_command, monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(hold_contract().encode())))
    assert run_command("check", "-")[0] == ExitCode.SUCCESS


@pytest.mark.parametrize("form", ["validation", "decoding"])
def test_schema_is_valid_draft_7_and_accepts_what_check_accepts(run_command, form):
    code, out, _ = run_command("schema", "--scene", "bare:0", "--form", form)
    assert code == ExitCode.SUCCESS
    schema = json.loads(out)
    jsonschema.Draft7Validator.check_schema(schema)
    if form == "validation":
        assert schema["$schema"].startswith("http://json-schema.org/draft-07")
    validator = jsonschema.Draft7Validator(schema)
    for text in (GOOD, hold_contract(), decline_contract()):
        validator.validate(json.loads(text))
    for text in (contract_text(("grasp", {**GRASP, "force": 900.0})), contract_text(("throw", {})), "{}"):
        assert not validator.is_valid(json.loads(text))
    too_narrow = contract_text(("grasp", {**GRASP, "opening": 0.03}))
    assert validator.is_valid(json.loads(too_narrow)) == (form == "validation"), "the cube is 40 mm wide"


def test_the_short_form_is_for_people(run_command):
    code, out, _ = run_command("schema", "--form", "short")
    assert code == ExitCode.SUCCESS
    assert "grasp" in out
    assert "m/s" in out


def test_replay_of_a_run_is_identical(run_command, completed_run):
    folder, *_ = completed_run
    code, out, err = run_command("replay", folder / "run" / "episode.mcap", "--json")
    data = json.loads(out)
    assert code == ExitCode.SUCCESS
    assert data["identical"]
    assert data["complete"]
    assert data["ticks"] > 5000
    assert "bit for bit" in err


def test_replay_of_what_is_no_recording(run_command, tmp_path):
    (tmp_path / "no.mcap").write_bytes(b"hello")
    for name in ("no.mcap", "missing.mcap"):
        code, out, err = run_command("replay", name)
        assert (code, out) == (ExitCode.SETUP, "")
        assert name in err


def test_a_run_is_exported_as_one_episode(run_command, completed_run, tmp_path):
    folder, *_ = completed_run
    code, out, err = run_command("export", "lerobot", folder / "run", "--out", "cubes", "--json")
    data = json.loads(out)
    episode = data["episodes"][0]
    assert code == ExitCode.SUCCESS
    assert (episode["run"], episode["task"]) == ("run", "put the red cube in the bowl")
    assert data["frames"] == episode["frames"] > 100
    assert f"cubes: 1 episode, {data['frames']} frames" in err
    assert {path.name for path in (tmp_path / "cubes").iterdir()} == {"data", "meta"}


def test_models_list_names_every_file_with_its_licence(run_command, monkeypatch):
    monkeypatch.setenv("COLUMNS", "30")  # names stay whole, so that they can be copied
    code, out, _ = run_command("models", "list")
    assert code == ExitCode.SUCCESS
    for name in ("qwen2.5-coder-1.5b-instruct", "smollm2-135m-instruct", "minilm-l6-v2-int8", "Apache-2.0"):
        assert name in out


def test_an_unknown_model_is_answered_with_the_closest(run_command):
    code, _, err = run_command("models", "fetch", "smolm2-135m-instruct")
    assert code == ExitCode.SETUP
    assert "Closest: 'smollm2-135m-instruct'" in err


def test_doctor_examines_everything(completed_run):
    folder, *_ = completed_run
    done = run_in_process(folder, "doctor", COLUMNS="200")
    assert done.returncode == ExitCode.SUCCESS, done.stdout
    for word in ("kernel", "filter step", "rendering", "minilm-l6-v2-int8", "memory", "hash chain intact", "µs"):
        assert word in done.stdout


@pytest.mark.parametrize("home", ["file", "file/below/it", "broken_link"])
def test_doctor_reports_a_data_folder_that_cannot_be_one(tmp_path, monkeypatch, home):
    (tmp_path / "file").write_text("text")
    (tmp_path / "broken_link").symlink_to(tmp_path / "absent")
    monkeypatch.setenv("DUALBRAIN_HOME", str(tmp_path / home))
    (found,) = doctor._memory()
    assert found.state == "problem"
    assert f"{tmp_path / home.partition('/')[0]} is not a folder" in found.text
    assert "set DUALBRAIN_HOME" in found.text


def test_doctor_reports_a_data_folder_that_does_not_exist_yet_as_empty(tmp_path, monkeypatch):
    monkeypatch.setenv("DUALBRAIN_HOME", str(tmp_path / "new" / "folder"))
    assert [(one.state, one.text) for one in doctor._memory()] == [("ok", "empty: no run yet")]


TEXT_ENCODER = ("minilm-l6-v2-int8", "minilm-l6-v2-tokenizer")


def test_doctor_reports_missing_model_files_as_optional_and_a_missing_text_encoder_as_a_problem(tmp_path):
    done = run_in_process(tmp_path, "doctor", COLUMNS="200", XDG_CACHE_HOME=str(tmp_path / "empty"))
    assert done.returncode == ExitCode.SETUP, done.stdout
    assert "needs smollm2-135m-instruct" in done.stdout
    lines = [line for line in done.stdout.splitlines() if "dualbrain models fetch" in line]
    assert {line.split()[1] for line in lines if line.split()[0] == "problem"} == set(TEXT_ENCODER)
    assert {line.split()[0] for line in lines} == {"problem", "optional"}
    with pytest.raises(MissingDependencyError, match="dualbrain models fetch minilm-l6-v2-int8"):
        run_session(run_config(tmp_path, cache=tmp_path / "empty"), hold_contract())


def test_a_missing_text_encoder_is_optional_where_no_run_is_installed(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for package in doctor.RUN_PACKAGES:
        with monkeypatch.context() as patch:
            patch.setattr(doctor, "find_spec", lambda name, missing=package: None if name == missing else name)
            states = {one.item: one.state for one in doctor._model_files()}
        assert [states[name] for name in TEXT_ENCODER] == ["optional", "optional"]


def test_a_model_file_that_was_copied_with_another_date_is_present_and_verified_at_the_next_use(tmp_path, monkeypatch):
    file = find_weight_file("minilm-l6-v2-tokenizer")
    path = tmp_path / "dualbrain" / file.filename
    path.parent.mkdir()
    with open(path, "wb") as written:
        written.truncate(file.size)
    write_stamp(path, file.sha256)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    states = [(one.state, one.text) for one in doctor._model_files() if one.item == file.name]
    os.utime(path, (1, 1))
    states += [(one.state, one.text) for one in doctor._model_files() if one.item == file.name]
    assert states == [("ok", "verified"), ("ok", "present, verified at the next use")]


@pytest.mark.parametrize(
    "arguments", [("run", "x", "--nonsense"), ("fly",), ("check",), ("run", "x", "--filter", "maybe")]
)
def test_wrong_usage_is_2(run_command, arguments):
    code, out, err = run_command(*arguments)
    assert code == ExitCode.USAGE
    assert out + err  # the error is reported


def test_help_lists_every_command(run_command):
    code, out, _ = run_command("--help")
    assert code == ExitCode.SUCCESS
    for name in ("run", "demo", "schema", "check", "replay", "doctor", "models", "robot", "export"):
        assert name in out


@pytest.mark.parametrize(
    ("command", "function"),
    [
        (("evaluate",), evaluate),
        (("report",), report),
        (("compare",), compare),
        (("export", "lerobot"), export_lerobot),
        (("run",), run),
        (("adapters", "explore"), explore),
    ],
)
def test_the_help_contains_the_docstring_of_the_function(run_command, command, function):
    docstring = " ".join(inspect.getdoc(function).partition("Parameters\n")[0].replace("`", "").split())
    code, out, _ = run_command(*command, "--help")
    assert code == ExitCode.SUCCESS
    assert docstring
    assert docstring in " ".join(out.replace("`", "").split())


def test_the_demo_is_planned_by_one_that_comes_with_dualbrain_and_knows_its_robot():
    """What is shown first needs no large model; the set-up fetches what the same planner needs."""
    planner = inspect.signature(demo).parameters["planner"].default
    card = read_adapter_card(packaged_folder(planner))
    require_compatible(card, "panda", load_skill_registry("panda").hash)
    makefile = Path(__file__).parents[2].joinpath("Makefile").read_text()
    assert f"PLANNER ?= {planner}\n" in makefile
