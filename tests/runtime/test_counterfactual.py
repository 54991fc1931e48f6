"""Whether a memory was of use is told by asking the planner again without it: from the question to the last record."""

import json

import msgspec
import pytest

from dualbrain.contracts.registry import SkillRegistry
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.planner.protocol import LENGTH, TIMEOUT
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.records import MemoryUse
from dualbrain.runtime.inspection.counterfactual import CounterfactualQueries
from tests.stories.story_session import (
    contract_text,
    hold_contract,
    ledger_episodes,
    ledger_kinds,
    run_config,
    run_session,
)
from tests.support.run_once import run_once

REGISTRY: SkillRegistry = load_skill_registry("panda")


def _two_runs(folder):
    """A pause is remembered; the second run follows it, and without it the planner would have paused for longer."""
    for name, words, *answers in (
        ("one", "rest a little", hold_contract(0.7)),
        ("two", "rest a little more", hold_contract(0.7), hold_contract(1.5)),
    ):
        story = run_session(run_config(folder, name, instruction=words, utility=True), *answers)
    return story.episode, story.planner.requests, story.config


@pytest.fixture(scope="module")
def second(tmp_path_factory):
    return run_once(tmp_path_factory, "two_runs", _two_runs)


def test_the_question_is_the_first_one_less_one_memory(second):
    _, _, (first, without), _ = second
    (shown,) = first.recall.exemplars
    assert shown.episode_id == "one"
    assert without == msgspec.structs.replace(first, recall=msgspec.structs.replace(first.recall, exemplars=()))


def test_what_became_of_the_memory_stands_in_episode_and_ledger(second):
    _, episode, _, config = second
    assert episode.uses == (MemoryUse("one", used=True, contributing=True),)
    assert json.loads((config.out / "episode.json").read_bytes())["uses"] == list(msgspec.to_builtins(episode.uses))
    assert ledger_kinds(config.ledger)[-2:] == ["used", "run_ended"]
    assert "uses" not in ledger_episodes(config.ledger)[-1]["episode"]


def ask(second, answers, tmp_path, finish="stop", **how):
    """The uses in the second run's episode if the planner had said this without memory, and how often it was asked."""
    planner = ScriptedPlanner(answers, finish_reason=finish)
    asking = CounterfactualQueries(planner, REGISTRY, tmp_path)
    return asking.memory_uses(second[1], **how), len(planner.requests)


def test_a_memory_without_which_the_same_is_said_was_not_used(second, tmp_path):
    assert ask(second, [hold_contract(0.71)], tmp_path) == ((MemoryUse("one", used=False, contributing=False),), 1)


def test_the_same_question_is_asked_once(second, tmp_path):
    used = (MemoryUse("one", used=True, contributing=True),)
    assert ask(second, [hold_contract(1.5)], tmp_path) == (used, 1)
    assert ask(second, [hold_contract(0.7)], tmp_path) == (used, 0)


@pytest.mark.parametrize("torn", [b"", b'{"text": "paus', b'{"planner": "scripted"}', b"\xff", b"[]"])
def test_an_answer_whose_file_is_torn_is_asked_for_again_and_written_anew(second, tmp_path, torn):
    used = (MemoryUse("one", used=True, contributing=True),)
    assert ask(second, [hold_contract(1.5)], tmp_path) == (used, 1)
    (file,) = tmp_path.iterdir()
    file.write_bytes(torn)
    assert ask(second, [hold_contract(1.5)], tmp_path) == (used, 1)
    assert ask(second, [hold_contract(0.7)], tmp_path) == (used, 0)


@pytest.mark.parametrize("answer", ["no contract", "", "[]"])
def test_a_memory_without_which_nothing_can_be_read_was_used(second, tmp_path, answer):
    assert ask(second, [answer], tmp_path)[0][0].used
    assert ask(second, [hold_contract(0.7)], tmp_path / "cut", LENGTH)[0][0].used


def test_no_answer_is_no_evidence_and_is_not_kept(second, tmp_path):
    assert ask(second, [hold_contract(1.5)], tmp_path, TIMEOUT) == ((), 1)
    assert ask(second, [hold_contract(1.5)], tmp_path, enough=lambda: True) == ((), 0)
    assert not list(tmp_path.iterdir())
    assert ask(second, [hold_contract(1.5)], tmp_path)[0][0].used


def test_a_contract_that_came_after_a_refusal_is_not_credited_to_a_memory_that_changed_nothing(second, tmp_path):
    episode = second[1]
    bad = contract_text(("throw", {"object": "red_cube"}))
    refused = msgspec.structs.replace(
        episode.attempts[0], proposal=msgspec.structs.replace(episode.attempts[0].proposal, text=bad)
    )
    twice = msgspec.structs.replace(episode, attempts=(refused, *episode.attempts))
    found = CounterfactualQueries(ScriptedPlanner([bad]), REGISTRY, tmp_path).memory_uses(twice)
    assert found == (MemoryUse("one", used=False, contributing=False),)
