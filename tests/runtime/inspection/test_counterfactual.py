"""The use of a memory is determined by planning again without it: requests, cache and records."""

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
    """The second run uses the hold of the first one; without its memory, the planner would have held for longer."""
    for name, instruction, *answers in (
        ("one", "rest a little", hold_contract(0.7)),
        ("two", "rest a little more", hold_contract(0.7), hold_contract(1.5)),
    ):
        story = run_session(run_config(folder, name, instruction=instruction, utility=True), *answers)
    return story.episode, story.planner.requests, story.config


@pytest.fixture(scope="module")
def second(tmp_path_factory):
    return run_once(tmp_path_factory, "two_runs", _two_runs)


def test_the_counterfactual_request_is_the_first_one_without_one_memory(second):
    _, _, (first, without), _ = second
    (shown,) = first.recall.exemplars
    assert shown.episode_id == "one"
    assert without == msgspec.structs.replace(first, recall=msgspec.structs.replace(first.recall, exemplars=()))


def test_the_use_of_the_memory_is_stored_in_episode_and_ledger(second):
    _, episode, _, config = second
    assert episode.uses == (MemoryUse("one", used=True, contributing=True),)
    assert json.loads((config.out / "episode.json").read_bytes())["uses"] == list(msgspec.to_builtins(episode.uses))
    assert ledger_kinds(config.ledger)[-2:] == ["used", "run_ended"]
    assert "uses" not in ledger_episodes(config.ledger)[-1]["episode"]


def query(second, answers, tmp_path, finish="stop", **options):
    """The memory uses of the second run for the counterfactual `answers`, and the number of requests."""
    planner = ScriptedPlanner(answers, finish_reason=finish)
    queries = CounterfactualQueries(planner, REGISTRY, tmp_path)
    return queries.memory_uses(second[1], **options), len(planner.requests)


def test_a_memory_without_which_the_answer_is_the_same_was_not_used(second, tmp_path):
    assert query(second, [hold_contract(0.71)], tmp_path) == ((MemoryUse("one", used=False, contributing=False),), 1)


def test_the_same_request_is_sent_once(second, tmp_path):
    used = (MemoryUse("one", used=True, contributing=True),)
    assert query(second, [hold_contract(1.5)], tmp_path) == (used, 1)
    assert query(second, [hold_contract(0.7)], tmp_path) == (used, 0)


def test_a_planner_of_the_same_name_with_another_prompt_is_asked_again(second, tmp_path, monkeypatch):
    assert query(second, [hold_contract(1.5)], tmp_path) == ((MemoryUse("one", used=True, contributing=True),), 1)
    monkeypatch.setattr(ScriptedPlanner, "template", "0123456789abcdef", raising=False)
    unused = (MemoryUse("one", used=False, contributing=False),)
    assert query(second, [hold_contract(0.71)], tmp_path) == (unused, 1)


@pytest.mark.parametrize("damaged", [b"", b'{"text": "paus', b'{"planner": "scripted"}', b"\xff", b"[]"])
def test_an_answer_in_a_damaged_file_is_requested_and_stored_again(second, tmp_path, damaged):
    used = (MemoryUse("one", used=True, contributing=True),)
    assert query(second, [hold_contract(1.5)], tmp_path) == (used, 1)
    (file,) = tmp_path.iterdir()
    file.write_bytes(damaged)
    assert query(second, [hold_contract(1.5)], tmp_path) == (used, 1)
    assert query(second, [hold_contract(0.7)], tmp_path) == (used, 0)


@pytest.mark.parametrize("answer", ["no contract", "", "[]"])
def test_a_memory_without_which_the_answer_has_no_contract_was_used(second, tmp_path, answer):
    assert query(second, [answer], tmp_path)[0][0].used
    assert query(second, [hold_contract(0.7)], tmp_path / "cut", LENGTH)[0][0].used


def test_a_missing_answer_is_no_evidence_and_is_not_cached(second, tmp_path):
    assert query(second, [hold_contract(1.5)], tmp_path, TIMEOUT) == ((), 1)
    assert query(second, [hold_contract(1.5)], tmp_path, should_stop=lambda: True) == ((), 0)
    assert not list(tmp_path.iterdir())
    assert query(second, [hold_contract(1.5)], tmp_path)[0][0].used


def test_a_contract_after_a_rejection_is_not_credited_to_a_memory_without_effect(second, tmp_path):
    episode = second[1]
    bad = contract_text(("throw", {"object": "red_cube"}))
    refused = msgspec.structs.replace(
        episode.attempts[0], proposal=msgspec.structs.replace(episode.attempts[0].proposal, text=bad)
    )
    twice = msgspec.structs.replace(episode, attempts=(refused, *episode.attempts))
    found = CounterfactualQueries(ScriptedPlanner([bad]), REGISTRY, tmp_path).memory_uses(twice)
    assert found == (MemoryUse("one", used=False, contributing=False),)
