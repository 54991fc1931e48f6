"""What `dualbrain run` prints, writes and returns."""

import json
from pathlib import Path

import msgspec
import pytest

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.run.execution import describe_end, describe_judgement, exit_code, is_success, run_summary
from dualbrain.cli.run.run import run
from dualbrain.contracts.verdict import Rejected
from dualbrain.errors import UsageError
from dualbrain.planner.prompt.short_prompt import short_template_hash
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.records import (
    Attempt,
    Episode,
    Judgement,
    JudgementBasis,
    Outcome,
    Proposal,
    RetrievedContext,
    Scene,
    Violation,
)
from dualbrain.runtime import run_resources
from dualbrain.runtime.run_folder import RUN_FILES
from dualbrain.simulation.scenes.scene_spec import load_scene
from tests.stories.story_session import hold_contract, ledger_episodes

KEYS = {
    "success",
    "violations",
    "contract",
    "verdict",
    "delta",
    "intervention_frequency",
    "h_min",
    "timings",
    "out",
}


def test_json_is_exactly_one_object_with_the_promised_keys(completed_run):
    _, _, out, _ = completed_run
    data = json.loads(out)  # one object, and nothing beside it
    assert out.count("\n") == 1
    assert data.keys() >= KEYS
    assert data["verdict"]["verdict"] == "accepted"
    assert data["contract"]["action_sequence"][0]["skill"] == "grasp"
    assert data["timings"].keys() >= {"gate", "motion", "planner"}


def test_json_agrees_with_the_episode_on_disk(completed_run):
    folder, _, out, _ = completed_run
    data = json.loads(out)
    episode = msgspec.json.decode((folder / "run" / "episode.json").read_bytes(), type=Episode)
    assert data["success"] == is_success(episode)
    assert data["delta"] == episode.outcome.Delta
    assert data["h_min"] == episode.outcome.h_min
    assert data["violations"] == json.loads(msgspec.json.encode(episode.judgement.violations))
    assert data["out"] == "run"


def test_the_pick_succeeds_by_robot_and_by_truth(completed_run):
    _, code, out, err = completed_run
    assert json.loads(out)["success"], err
    assert json.loads(out)["violations"] == []
    assert code == ExitCode.SUCCESS


def test_the_account_is_on_stderr(completed_run):
    _, _, out, err = completed_run
    for words in (
        "shot 1: accepted, syntax ✓ authorization ✓ envelope ✓: grasp red_cube → place blue_bowl",
        "grasp: lift",
        "intervention on",
        "weights:",
        "report:",
    ):
        assert words in err
        assert words not in out


def test_the_run_folder_holds_everything(completed_run):
    folder, *_ = completed_run
    run = folder / "run"
    assert {path.name for path in run.iterdir()} == set(RUN_FILES)
    assert json.loads((run / "config.json").read_bytes())["scene"] == "bare:0"
    assert load_scene(run / "scene.json").family == "bare"
    assert "data:image/" in (run / "report.html").read_text()


def test_the_ledger_remembers_the_run_and_not_the_truth(completed_run):
    folder, *_ = completed_run
    (remembered,) = ledger_episodes(folder / "ledger.sqlite")
    assert remembered["episode"]["outcome"]["kind"] == "succeeded"
    assert "judgement" not in remembered["episode"]


class Short(ScriptedPlanner):
    """Reads what an adapted planner reads."""

    template = short_template_hash()


def test_documents_that_a_planner_cannot_read_are_reported_once(run_command, monkeypatch):
    for kind, times in ((Short, 1), (ScriptedPlanner, 0)):
        monkeypatch.setattr(run_resources, "open_planner", lambda *_, kind=kind, **__: kind([hold_contract()]))
        _, _, err = run_command(
            "run", "rest", "--scene", "bare:0", "--headless", "--knowledge", "on", "--out", kind.__name__
        )
        assert err.count("documents are not shown to scripted") == times
    assert "not shown" not in run_command("run", "rest", "--scene", "bare:0", "--headless", "--out", "none")[2]
    Path("rules.md").write_text("# Rules\n\nThe red cube must be gripped with at most 8 N.\n")
    run_command("knowledge", "add", "rules.md", "--trust", "site")
    monkeypatch.setattr(run_resources, "open_planner", lambda *_, **__: Short([hold_contract()]))
    _, _, err = run_command("run", "rest", "--scene", "bare:0", "--headless", "--out", "site")
    assert err.count("documents are not shown to scripted") == 1


def test_no_document_is_opened_for_a_planner_that_reads_none(run_command, monkeypatch):
    monkeypatch.setattr(run_resources, "open_planner", lambda *_, **__: Short([hold_contract()]))
    monkeypatch.setattr(run_resources, "open_library", lambda *_, **__: pytest.fail("documents were opened"))
    run_command("run", "rest", "--scene", "bare:0", "--headless", "--knowledge", "on", "--out", "short")


# --- exit codes ---------------------------------------------------------------------------------------------------


def episode(kind, *, truth=True, violations=(), judged=True, readable=True, check="none"):
    basis = JudgementBasis(judged=readable, reason="The instruction could not be read.")
    judgement = Judgement(truth and readable, float(truth), violations, basis) if judged else None
    refused = Attempt(
        Proposal(text="", finish_reason="stop", planner="t", constrained_by="t", timings={}),
        Rejected(stage="syntax", pointer="", got=0, allowed=0, hint="hint"),
        0.0,
    )
    return Episode(
        id="e",
        started="",
        instruction="",
        robot="panda",
        registry="",
        seed=0,
        scene=Scene(robot="panda", stamp=0.0, version=1, objects=()),
        summary="",
        recall=RetrievedContext(),
        attempts=(refused,),
        contract=None,
        outcome=Outcome(kind=kind, reason=""),
        judgement=judgement,
        second_opinion=check,
        timings={},
        versions={},
    )


BREACH = (Violation(kind="collision_env", start=0.0, duration=0.1, peak=5.0, bodies=("hand", "can")),)


@pytest.mark.parametrize(
    ("kind", "facts", "code"),
    [
        ("succeeded", {}, ExitCode.SUCCESS),
        ("succeeded", {"truth": False}, ExitCode.FAILED_SAFELY),
        ("succeeded", {"judged": False}, ExitCode.NOT_JUDGED),
        ("succeeded", {"judged": False, "check": "agrees"}, ExitCode.SUCCESS),
        ("succeeded", {"judged": False, "check": "disagrees"}, ExitCode.FAILED_SAFELY),
        ("succeeded", {"readable": False}, ExitCode.NOT_JUDGED),
        ("succeeded", {"readable": False, "check": "agrees"}, ExitCode.SUCCESS),
        ("succeeded", {"truth": False, "check": "agrees"}, ExitCode.FAILED_SAFELY),
        ("succeeded", {"check": "disagrees"}, ExitCode.SUCCESS),
        ("failed", {"judged": False}, ExitCode.FAILED_SAFELY),
        ("succeeded", {"violations": BREACH}, ExitCode.VIOLATION),
        ("failed", {}, ExitCode.FAILED_SAFELY),
        ("failed", {"violations": BREACH}, ExitCode.VIOLATION),
        ("taken_over", {"truth": False}, ExitCode.FAILED_SAFELY),
        ("stopped", {"truth": False}, ExitCode.FAILED_SAFELY),
        ("rejected", {"truth": False}, ExitCode.REJECTED),
        ("declined", {"truth": False}, ExitCode.REJECTED),
        ("aborted", {"truth": False}, ExitCode.INTERRUPTED),
        ("aborted", {"truth": False, "violations": BREACH}, ExitCode.INTERRUPTED),
    ],
)
def test_exit_codes(kind, facts, code):
    one = episode(kind, **facts)
    assert exit_code(one) == code
    assert json.loads(msgspec.json.encode(run_summary(one, "out"))).keys() >= KEYS


def test_the_output_states_that_an_instruction_was_not_judged():
    one = episode("succeeded", readable=False)
    assert describe_judgement(one) == "simulator ground truth: not judged (The instruction could not be read.)"
    summary = run_summary(one, "out")
    assert (summary["success"], summary["judged"]) == (False, False)
    assert describe_end(one) == "contract completed, instruction not judged"
    assert describe_end(episode("succeeded", truth=False)) == "contract completed, instruction not carried out"
    assert describe_end(episode("succeeded")) == "succeeded"


def test_the_codes_are_the_published_ones():
    assert [int(code) for code in ExitCode] == [0, 1, 2, 3, 4, 5, 6, 130]


@pytest.mark.parametrize("epsilon", [-1.0, float("nan"), float("inf")])
def test_an_epsilon_that_is_none_is_refused_before_anything_opens(epsilon):
    with pytest.raises(UsageError, match="--epsilon"):
        run("put the red cube in the bowl", epsilon=epsilon)
