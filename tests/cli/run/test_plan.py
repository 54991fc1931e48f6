"""dualbrain plan: the prompt, what was retrieved, the contract, the verdict; nothing moves, memory is only read."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from dualbrain.adaptation.serving import open_planner
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.grounding.envelope.robot_at_site import open_robot_at_site
from dualbrain.planner.prompt.full_prompt import template_hash
from dualbrain.planner.prompt.prompt_format import short_messages
from dualbrain.planner.prompt.short_prompt import short_template_hash
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.skills.registry import skill_registry
from tests.stories.story_session import (
    GRASP,
    PLACE,
    contract_text,
    decline_contract,
    hold_contract,
    run_config,
    run_session,
)

PICK = contract_text(("grasp", GRASP), ("place", PLACE))
FAST = contract_text(("grasp", {**GRASP, "speed": 30.0}), ("place", PLACE))
WORDS = "grip the red cube with a force that it bears and put it in the bowl"


SITE = """
[robot]
tool_speed = 0.3
[object.red_cube]
force = 8.0
[commander.planner]
skills = [{skills}]
"""


@pytest.fixture
def script(monkeypatch, tmp_path):
    """Sets the answers of the planner that the command will open; memory and documents are the test's own."""
    monkeypatch.setenv("DUALBRAIN_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("COLUMNS", "200")

    def answering(*texts, **more):
        planner = ScriptedPlanner(texts, **more)
        monkeypatch.setattr(open_planner, "open_planner", lambda *_, **__: planner)
        return planner

    return answering


def test_an_accepted_plan_shows_prompt_contract_verdict_and_time(run_command, script):
    script(PICK)
    code, out, _ = run_command("plan", WORDS, "--scene", "bare:0", "--knowledge", "off")
    assert code == ExitCode.SUCCESS
    for words in ("[system]", "You plan for the robot arm", WORDS, PICK, "nothing", "accepted: syntax ✓"):
        assert words in out
    assert "decided in" in out


def test_a_rejection_is_in_the_second_prompt_and_the_last_verdict_counts(run_command, script):
    planner = script(FAST, PICK)
    code, out, _ = run_command("plan", WORDS, "--scene", "bare:0", "--knowledge", "off", "--json")
    data = json.loads(out)
    assert (code, data["accepted"], data["declined"]) == (ExitCode.SUCCESS, True, False)
    assert [shot["verdict"].get("stage") for shot in data["shots"]] == ["envelope", None]
    assert "<refusal>" in data["shots"][1]["prompt"][-1]["content"]
    assert data["contract"]["action_sequence"][0]["params"]["object"] == "red_cube"
    assert [request.contract_id for request in planner.requests] == ["c-0001", "c-0002"]
    assert {"retrieval", "planner", "gate", "decision"} <= data["timings"].keys()


@pytest.mark.parametrize(
    ("answers", "stage"), [((FAST,), "envelope"), (("no JSON",), "syntax"), ((decline_contract(),), None)]
)
def test_a_rejection_and_a_decline_exit_3(run_command, script, answers, stage):
    planner = script(*answers)
    code, out, _ = run_command("plan", WORDS, "--scene", "bare:0", "--knowledge", "off", "--shots", "1", "--json")
    data = json.loads(out)
    assert code == ExitCode.REJECTED
    assert data["verdict"].get("stage") == stage
    assert data["declined"] == (stage is None)
    assert len(planner.requests) == 1


def test_a_planner_that_does_not_answer_is_called_once_and_nothing_is_rejected(run_command, script):
    planner = script("", finish_reason="error: ConnectionRefusedError")
    code, out, _ = run_command("plan", WORDS, "--scene", "bare:0", "--knowledge", "off", "--shots", "5")
    assert (code, len(planner.requests)) == (ExitCode.FAILED_SAFELY, 1)
    assert "no answer: the planner did not answer: ConnectionRefusedError" in out
    assert "rejected" not in out


def test_memories_and_passages_are_shown_with_their_scores_and_citations(run_command, script, tmp_path):
    config = run_config(tmp_path, ledger=tmp_path / "ledger.sqlite")
    run_session(replace(config, instruction="hold still"), hold_contract())
    before = config.ledger.read_bytes()
    planner = script(PICK)
    arguments = ("plan", WORDS, "--scene", "bare:0", "--ledger", str(config.ledger), "--knowledge", "on")
    code, out, _ = run_command(*arguments, "--json")
    data = json.loads(out)["retrieved"]
    assert code == ExitCode.SUCCESS
    assert data["passages"]
    assert all("@" in one["citation"] for one in data["passages"])
    found = [*data["exemplars"], *data["warnings"]]
    assert found
    assert len(planner.requests[0].recall.passages) == len(data["passages"])
    code, out, _ = run_command(*arguments)
    assert data["passages"][0]["citation"] in out
    for one in found:
        assert one["episode_id"] in out
    assert config.ledger.read_bytes() == before


class Short(ScriptedPlanner):
    """Reads what an adapted planner reads."""

    template, messages = short_template_hash(), staticmethod(short_messages)


def test_context_that_an_adapted_planner_does_not_read_is_marked_and_reported_once(
    run_command, script, tmp_path, monkeypatch
):
    config = run_config(tmp_path, ledger=tmp_path / "ledger.sqlite")
    run_session(replace(config, instruction=WORDS), hold_contract())
    script()
    monkeypatch.setattr(open_planner, "open_planner", lambda *_, **__: Short([FAST, PICK]))
    arguments = ("plan", WORDS, "--scene", "bare:0", "--ledger", str(config.ledger), "--knowledge", "on")
    _, out, err = run_command(*arguments)
    assert err.count("documents are not shown to scripted") == 1
    assert "passage (not in the prompt of this planner)" in out
    _, out, _ = run_command(*arguments, "--json")
    data = json.loads(out)
    assert data["template"] == short_template_hash()
    found = {name for name in ("warnings", "passages") if data["retrieved"][name]}
    assert "passages" in found
    assert set(data["unread"]) == found
    prompts = json.dumps([shot["prompt"] for shot in data["shots"]])
    assert not any(one["citation"] in prompts for one in data["retrieved"]["passages"])
    assert "documents are not shown" not in run_command(*arguments[:-1], "off")[2]
    assert "documents are not shown" not in run_command(*arguments[:-1], "site")[2]
    Path("rules.md").write_text("# Rules\n\nThe red cube must be gripped with at most 8 N.\n")
    run_command("knowledge", "add", "rules.md", "--trust", "site")
    _, out, err = run_command(*arguments[:-1], "site")
    assert err.count("documents are not shown to scripted") == 1
    assert "passage (not in the prompt of this planner)" in out


def test_a_planner_with_the_full_prompt_reads_all_that_was_found(run_command, script):
    script(PICK)
    _, out, err = run_command("plan", WORDS, "--scene", "bare:0", "--knowledge", "on", "--json")
    data = json.loads(out)
    assert (data["unread"], data["template"]) == ([], template_hash())
    assert data["retrieved"]["passages"]
    assert "not shown" not in err


@pytest.mark.parametrize(("knowledge", "kept"), [("off", set()), ("site", set()), ("on", {"knowledge.sqlite"})])
def test_at_home_it_writes_the_shipped_documents_and_nothing_else(run_command, script, tmp_path, knowledge, kept):
    script(FAST, PICK)
    for _ in range(2):
        run_command("plan", WORDS, "--scene", "bare:0", "--knowledge", knowledge)
        home = tmp_path / "home"
        assert {path.name for path in (home.iterdir() if home.exists() else ())} == kept


def test_an_unknown_ledger_and_an_empty_instruction_are_reported(run_command, script, tmp_path):
    script(PICK)
    assert run_command("plan", "  ")[0] == ExitCode.USAGE
    assert run_command("plan", WORDS, "--shots", "0")[0] == ExitCode.USAGE
    code, _, err = run_command("plan", WORDS, "--ledger", str(tmp_path / "none.sqlite"), "--knowledge", "off")
    assert code == ExitCode.SETUP
    assert "none.sqlite" in err


def test_the_help_describes_the_command(run_command):
    code, out, _ = run_command("plan", "--help")
    assert code == ExitCode.SUCCESS
    for words in ("Memory is only read", "built-in documents", "citations", "--contract c.json", "Exit code 0"):
        assert words in " ".join(out.replace("│", " ").split())


def with_grip_force(newtons, **more):
    return contract_text(("grasp", {**GRASP, "force": newtons}), ("place", PLACE), **more)


@pytest.mark.parametrize(
    ("force", "skills", "stage"),
    [
        (7.0, '"grasp", "place", "decline"', None),
        (9.0, '"grasp", "place", "decline"', "envelope"),
        (7.0, '"move_to", "decline"', "authorization"),
    ],
)
def test_the_limits_and_grants_of_a_site_apply_to_a_plan_and_a_check(
    run_command, script, tmp_path, force, skills, stage
):
    site, contract = tmp_path / "lab.toml", tmp_path / "contract.json"
    site.write_text(SITE.format(skills=skills))
    registry = skill_registry(open_robot_at_site("panda", site).robot_model).hash
    answer = with_grip_force(force, registry=registry)
    script(answer)
    options = ("--scene", "bare:0", "--site", str(site))
    code, out, err = run_command("plan", WORDS, *options, "--knowledge", "off", "--json", "--shots", "1")
    assert json.loads(out)["shots"][-1]["verdict"].get("stage") == stage
    assert code == (ExitCode.SUCCESS if stage is None else ExitCode.REJECTED)
    assert "limits of the site for red_cube: force at most 8 N" in " ".join(err.split())
    contract.write_text(answer)
    code, out, _ = run_command("check", str(contract), *options)
    assert json.loads(out).get("stage") == stage
    contract.write_text(with_grip_force(9.0))
    assert run_command("check", str(contract), "--scene", "bare:0")[0] == ExitCode.SUCCESS
