"""Precedents: contracts with the evidence of their outcomes, found by the scene or by the contract."""

from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from dualbrain.memory.ledger.ledger import Ledger
from dualbrain.memory.memory import Memory
from dualbrain.records import OutcomeCheck, OutcomeClass
from tests.memory.memory_samples import CONFIG, NOW, REST_POSTURE, episode, grasp_contract, open_ledger, open_memory

WORDS, SCENE = "put the red cube in the bowl", "neighbour_across low"
SCOPE = ("arm", "aaaa1111")


def similar(memory: Memory, max_count: int = 5) -> list[str]:
    found = memory.find_precedents(SCENE, REST_POSTURE, *SCOPE, max_count=max_count)
    return [one.episode_id for one in found]


def outcomes(memory: Memory, max_count: int = 5) -> list[tuple[str, str]]:
    return [
        (one.episode_id, one.evidence) for one in memory.find_outcomes(grasp_contract(), *SCOPE, max_count=max_count)
    ]


def test_successes_are_found_by_the_scene_and_for_any_instruction(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        for one in (
            episode("far", instruction=WORDS, summary="person: crossing, overhead shelf, tight, fragile"),
            episode("same", instruction="push the mug away"),
            episode("failed", kind="failed"),
            episode("declined", kind="declined"),
            episode("other skills", registry="bbbb2222"),
        ):
            memory.store(one, REST_POSTURE, now=NOW)
        assert similar(memory) == ["same"]
        (found,) = memory.find_precedents(SCENE, REST_POSTURE, *SCOPE, max_count=1)
    assert (found.scene, found.q) == (episode("same").scene, REST_POSTURE.q)
    assert (found.instruction, found.contract) == ("push the mug away", grasp_contract())


@pytest.mark.parametrize(
    ("kind", "opinion", "Delta", "evidence"),
    [
        ("succeeded", "agrees", 0.0, "clean"),
        ("succeeded", "agrees", 0.5, "unclean"),
        ("succeeded", "none", 0.0, "unconfirmed"),
        ("succeeded", "disagrees", 0.0, "against"),
        ("failed", "agrees", 0.0, "against"),
        ("failed", "disagrees", 0.0, "against"),
        ("taken_over", "agrees", 0.0, "against"),
        ("rejected", "none", None, "against"),
    ],
)
def test_the_evidence_of_an_outcome(
    tmp_path: Path, kind: OutcomeClass, opinion: OutcomeCheck, Delta: float | None, evidence: str
) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        memory.store(episode("e-1", kind, Delta=Delta, second_opinion=opinion), REST_POSTURE, now=NOW)
        assert outcomes(memory) == [("e-1", evidence)]


@pytest.mark.parametrize("kind", ["declined", "aborted", "stopped", "handed_over"])
def test_an_outcome_without_guidance_is_no_evidence(tmp_path: Path, kind: OutcomeClass) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        memory.store(episode("e-1", kind), REST_POSTURE, now=NOW)
        assert outcomes(memory) == []


def test_outcomes_are_those_of_the_contract_the_newest_first(tmp_path: Path) -> None:
    other = grasp_contract() | {"action_sequence": [{"skill": "home", "params": {"speed": 0.1}}]}
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        for name in ("a", "b", "c"):
            memory.store(episode(name, summary=f"scene {name}"), REST_POSTURE, now=NOW)
        memory.store(episode("other", plan=other), REST_POSTURE, now=NOW)
        assert [name for name, _ in outcomes(memory)] == ["c", "b", "a"]
        assert [name for name, _ in outcomes(memory, 2)] == ["c", "b"]
        assert memory.find_outcomes(grasp_contract(), "arm", "bbbb2222", max_count=5) == ()


def test_a_candidate_that_another_outcome_confirms_is_not_confirmed_in_its_own_place(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        memory.store(episode("first", second_opinion="none"), REST_POSTURE, now=NOW)
        assert memory.store(episode("second"), REST_POSTURE, now=NOW).confirmed_ids == ("first",)
        assert outcomes(memory) == [("second", "clean"), ("first", "unconfirmed")]


def test_with_frozen_weights_no_success_is_clean(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        open_memory(ledger).store(episode("e-1"), REST_POSTURE, now=NOW)
        static = Memory(ledger, open_memory(ledger).embedding.encoder, replace(CONFIG, plasticity=None))
        assert outcomes(static) == [("e-1", "unclean")]


def test_a_memory_whose_scene_cannot_be_read_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        memory.store(episode("old"), REST_POSTURE, now=NOW)
        memory.store(episode("new"), REST_POSTURE, now=NOW)
        read = Ledger.event

        def event(self: Ledger, seq: int) -> object:
            found = read(self, seq)
            is_old = b'"old"' in found.payload
            return replace(found, payload=found.payload.replace(b'"objects"', b'"things"')) if is_old else found

        monkeypatch.setattr(Ledger, "event", event)
        assert [name for name, _ in outcomes(memory)] == ["new"]
        assert msgspec.json.decode(read(ledger, memory.state["old"].seq).payload)
