"""Whole simulated episodes: false successes are not confirmed, and a recalled step is not repeated."""

import pytest

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.run.execution import exit_code
from dualbrain.runtime.planning import local_answer, proposal_checks
from dualbrain.skills.arm import grasp
from tests.stories.story_session import (
    GRASP,
    PLACE,
    contract_text,
    decline_contract,
    ledger_episodes,
    run_config,
    run_session,
)

HOME = {"speed": 0.25}
LEFT_OF_BOWL = "place the red cube to the left of the bowl"
CUBE = GRASP | {"object": "red_cube"}


def run(folder, instruction, *steps, name="run", scene="bare:0", text=""):
    config = run_config(folder, name, instruction=instruction, scene=scene, tries=1)
    return run_session(config, text or contract_text(*steps))


def verdicts(story):
    return {one.sense: one.verdict for one in story.episode.senses}


def press_at_once(arm, name, bound, open_fingers):
    """A grasp that closes with the largest force allowed, without a search for the least one that holds."""
    if why := (yield from arm.close_gripper(bound)):
        return why
    arm.record_grasp(arm.find_object(name))
    arm.watch_load(arm.find_object(name))
    return None


@pytest.mark.parametrize(("force", "check"), [(60.0, "disagrees"), (9.0, "agrees")])
def test_a_glass_is_a_confirmed_success_only_if_it_was_not_broken(tmp_path, monkeypatch, force, check):
    """The broken glass is at its place, and the skills report success: they press with the force of the contract."""
    monkeypatch.setattr(grasp, "max_grip_force", lambda robot_model, obj, force: force)
    monkeypatch.setattr(grasp, "_find_holding_force", press_at_once)
    steps = (
        ("grasp", GRASP | {"object": "clear_glass", "force": force}),
        ("place", PLACE | {"destination": "table_left"}),
    )
    story = run(tmp_path, "put the glass on the left side of the table", *steps, scene="fragile:74000")
    assert story.episode.outcome.kind == "succeeded"
    assert verdicts(story)["placed"] == "confirmed"
    assert verdicts(story)["intact"] == ("confirmed" if check == "agrees" else "contradicted")
    assert story.episode.second_opinion == check
    assert story.episode.judgement.success == (check == "agrees")
    assert story.result.store_report.status == ("active" if check == "agrees" else "quarantined")
    assert bool(story.result.store_report.weight_updates) == (check == "agrees")


def test_a_cube_in_the_bowl_is_not_left_of_it(tmp_path, monkeypatch):
    """A planner that drops the clause, and no check of the clause before it or of the contract after it."""
    monkeypatch.setattr(local_answer, "review_instruction", lambda *words, **languages: None)
    monkeypatch.setattr(proposal_checks, "find_uncovered", lambda *contract_and_goal: None)
    story = run(tmp_path, LEFT_OF_BOWL, ("grasp", CUBE), ("place", PLACE))
    assert story.episode.changes == "red cube in blue bowl; nothing else moved"
    assert story.episode.second_opinion == "disagrees"
    assert (story.episode.judgement.judged, story.episode.judgement.success) == (True, False)
    assert exit_code(story.episode) == ExitCode.FAILED_SAFELY
    assert story.result.store_report.status == "quarantined"


def test_a_contract_that_drops_a_clause_does_not_move_the_robot(tmp_path, monkeypatch):
    """The same planner without a check of the clause: the contract is compared with the words before the gate."""
    monkeypatch.setattr(local_answer, "review_instruction", lambda *words, **languages: None)
    story = run(tmp_path, LEFT_OF_BOWL, ("grasp", CUBE), ("place", PLACE))
    assert story.episode.outcome.kind == "rejected"
    assert 'no contract can state "left of"' in story.episode.outcome.reason
    assert exit_code(story.episode) == ExitCode.REJECTED


@pytest.mark.parametrize(
    ("instruction", "text", "success", "code"),
    [
        ("go home", contract_text(("home", HOME)), True, ExitCode.SUCCESS),
        ("stop", contract_text(("hold", {"duration": 0.5})), True, ExitCode.SUCCESS),
        ("put the banana in the bowl", decline_contract(), True, ExitCode.REJECTED),
        ("put the red cube in the bowl", decline_contract(), False, ExitCode.REJECTED),
        ("do something nice", contract_text(("hold", {"duration": 0.5})), False, ExitCode.NOT_JUDGED),
    ],
)
def test_ground_truth_judges_the_words(tmp_path, instruction, text, success, code):
    story = run(tmp_path, instruction, text=text)
    assert story.episode.judgement.success == success
    assert exit_code(story.episode) == code


def test_a_recalled_final_step_is_neither_shown_nor_executed(tmp_path):
    """The memory holds "then go home"; a planner that copies it is refused with a hint, and then leaves it out."""
    put = ("grasp", CUBE), ("place", PLACE)
    first = run(tmp_path, "put the red cube in the bowl, then go home", *put, ("home", HOME), name="one")
    assert first.result.store_report.status == "active"
    config = run_config(tmp_path, "two", instruction="put the red cube in the bowl", tries=1)
    story = run_session(config, contract_text(*put, ("home", HOME)), contract_text(*put, id="c-0002"))
    (shown,) = story.planner.requests[0].recall.exemplars
    assert [one["skill"] for one in shown.contract["action_sequence"]] == ["grasp", "place"]
    assert story.episode.withheld_skills == ("home",)
    assert "the instruction does not ask for home" in story.planner.requests[1].rejection.hint
    assert [one["skill"] for one in story.episode.contract["action_sequence"]] == ["grasp", "place"]
    assert story.episode.second_opinion == "agrees"
    assert len(ledger_episodes(config.ledger)) == 2
