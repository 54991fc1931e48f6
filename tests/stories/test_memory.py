"""A run retrieves the memory of the run before, and only the robot's own verdict updates memory."""

import pytest

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.run.execution import exit_code
from dualbrain.planner.prompt.full_prompt import render
from dualbrain.records import RetrievedContext
from tests.stories.story_session import (
    contract_text,
    decline_contract,
    hold_contract,
    ledger_episodes,
    run_config,
    run_session,
)
from tests.support.run_once import run_once

GOAL = "put the red_cube in the blue_bowl"
BAD = contract_text(("throw", {"object": "red_cube"}))


def _four_runs(folder):
    """Four runs with one ledger: a hold that counts as success, the same again, a rejection, and a decline."""
    results = []
    for name, instruction, answer, goal in (
        ("one", "rest a little", hold_contract(0.7), GOAL),
        ("two", "rest a little more", hold_contract(0.8), ""),
        ("three", "admire the cube", BAD, ""),
        ("four", "admire the cube, please", decline_contract(), ""),
    ):
        story = run_session(run_config(folder, name, instruction=instruction, goal=goal), answer)
        results.append(
            (
                story.episode,
                render(story.planner.requests[0]),
                story.result.store_report.weight_updates,
                story.config.ledger,
            )
        )
    return (results,)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    return run_once(tmp_path_factory, "four_runs", _four_runs)[1]


def test_the_first_run_retrieves_nothing(runs):
    episode, messages, *_ = runs[0]
    assert episode.recall.exemplars == ()
    assert not any("rest a little" in message["content"] for message in messages[:-1])


def test_the_second_run_retrieves_the_first_and_the_prompt_shows_it(runs):
    episode, messages, *_ = runs[1]
    (exemplar,) = episode.recall.exemplars
    assert exemplar.episode_id == "one"
    assert exemplar.succeeded
    exemplars = [index for index, message in enumerate(messages) if "rest a little\n" in message["content"]]
    assert exemplars
    answer = messages[exemplars[0] + 1]
    assert answer["role"] == "assistant"
    assert '"duration":0.7' in answer["content"]


def test_the_outcome_updates_the_weights_of_retrieved_memories(runs):
    changes = runs[1][2]
    assert [(change.memory, change.rank) for change in changes] == [("two", 0), ("one", 1)]
    assert all(change.after > change.before for change in changes)


def test_a_rejected_contract_is_a_warning_in_the_next_run(runs):
    episode, messages, *_ = runs[3]
    assert [warning.episode_id for warning in episode.recall.warnings] == ["three"]
    assert not episode.recall.warnings[0].succeeded
    assert {exemplar.episode_id for exemplar in episode.recall.exemplars} == {"one", "two"}
    assert "three" not in messages[-1]["content"]


def test_r_is_the_robots_own_verdict_even_if_ground_truth_differs(runs):
    """The robot's verdict is success; on ground truth no cube is in the bowl."""
    episode, _, changes, ledger = runs[0]
    assert episode.outcome.kind == "succeeded"
    assert not episode.judgement.success
    assert exit_code(episode) == ExitCode.FAILED_SAFELY
    assert changes[0].after > changes[0].before
    remembered = ledger_episodes(ledger)[0]["episode"]
    assert remembered["outcome"]["kind"] == "succeeded"
    assert "judgement" not in remembered


def test_a_given_contract_does_not_update_memories_that_were_not_shown(tmp_path):
    run_session(run_config(tmp_path, "one"), BAD)
    (tmp_path / "pause.json").write_text(hold_contract())
    config = run_config(tmp_path, "two", instruction="rest", contract=tmp_path / "pause.json")
    story = run_session(config, hold_contract())
    assert story.episode.recall == RetrievedContext()
    assert [change.memory for change in story.result.store_report.weight_updates] == ["two"]
