"""The audit finds planted faults and nothing else; utility and projection follow their definitions."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dualbrain.memory.maintenance.audit import audit, source_reports
from dualbrain.memory.maintenance.edits import quarantine, record_adapter, record_audit, record_uses
from dualbrain.memory.maintenance.export import export_rows
from dualbrain.memory.maintenance.projection import project_memories
from dualbrain.memory.maintenance.verification import verify
from dualbrain.memory.memory import Memory
from dualbrain.memory.plasticity.retrieval_utility import ExclusionEffect, evaluate_use, summarize_uses, was_used
from dualbrain.records import MemoryUse, OutcomeClass, RetrievedContext
from tests.memory.memory_samples import NOW, REST_POSTURE, episode, grasp_contract, open_ledger, open_memory

WORDS = ("put the red cube in the bowl", "open the drawer", "push the mug away", "turn off the lamp")


def _plan(number: int, **params: Any) -> dict[str, Any]:
    step = {"skill": "grasp", "params": {"object": f"object-{number}", "speed": 0.1, **params}}
    return {**grasp_contract(), "action_sequence": [step]}


def _clean(memory: Memory) -> None:
    """Store four situations, each three times with the same plan and the same outcome."""
    for i in range(12):
        one = episode(
            f"e-{i}",
            "succeeded" if i % 4 else "failed",
            Delta=0.002,
            instruction=WORDS[i % 4],
            summary=f"s{i % 4}",
            plan=_plan(i % 4, speed=0.1 + i * 1e-4),
        )
        memory.store(one, REST_POSTURE, now=NOW + i)


def _kinds(memory: Memory, kind: str) -> set[str]:
    return {one.memory for one in audit(memory).findings if one.kind == kind}


def test_a_clean_ledger_has_no_findings(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        _clean(memory)
        assert audit(memory).findings == ()


def test_a_false_outcome_is_found_by_similar_memories(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        _clean(memory)
        false_outcome = episode("false", Delta=0.0, instruction=WORDS[0], summary="s0", plan=_plan(0))
        memory.store(false_outcome, REST_POSTURE, now=NOW + 20)
        other_plan = episode("other plan", Delta=0.0, instruction=WORDS[0], summary="s0", plan=_plan(0, speed=0.3))
        memory.store(other_plan, REST_POSTURE, now=NOW + 21)
        assert _kinds(memory, "label conflict") == {"false"}
        (finding,) = [one for one in audit(memory).findings if one.kind == "label conflict"]
        assert set(finding.others) == {"e-0", "e-4", "e-8"}
        quarantine(memory, ["false"], "label conflict", now=NOW + 30)
        assert _kinds(memory, "label conflict") == set()


def test_repetitions_and_implausible_outcomes_are_found(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        for i in range(4):
            memory.store(episode(f"copy-{i}"), REST_POSTURE, now=NOW)
        memory.store(episode("struggle", Delta=0.2, instruction=WORDS[1], summary="x"), REST_POSTURE, now=NOW)
        memory.store(episode("odd", "failed", Delta=0.0, instruction=WORDS[2], summary="y"), REST_POSTURE, now=NOW)
        found = {one.kind: one for one in audit(memory).findings}
        assert (found["near duplicates"].memory, len(found["near duplicates"].others)) == ("copy-0", 3)
        assert (found["struggle"].memory, found["untouched failure"].memory) == ("struggle", "odd")
        record_audit(memory, audit(memory), now=NOW)
        assert open_memory(ledger).weights() == memory.weights()


def test_the_blast_radius_counts_the_changes_by_a_source(tmp_path: Path) -> None:
    """Oracle: the weight updates, computed by hand."""
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        memory.store(episode("a", proposer="old"), REST_POSTURE, now=NOW)
        for i in range(3):
            shown = memory.retrieve(WORDS[0], "neighbour_across low", REST_POSTURE, "arm", "aaaa1111", k=1)
            memory.store(
                episode(f"b-{i}", "failed", proposer="new", recall=RetrievedContext(shown.exemplars)),
                REST_POSTURE,
                now=NOW,
            )
        record_adapter(memory, "adapter-1", "d" * 8, ["b-1", "a"], now=NOW)
        first, second = source_reports(memory)
        moved = [0.575]
        for _ in range(3):
            moved.append(0.95 * moved[-1] - 0.2 * 0.5 * 1.0)
        assert (first.source, first.memories, first.touched) == ("new", ("b-0", "b-1", "b-2"), 1)
        assert first.moved == pytest.approx(moved[0] - max(0.0, moved[-1]), abs=0.02)
        assert (second.source, second.moved) == ("old", 0.0)
        assert (first.adapters, second.adapters) == (("adapter-1",), ("adapter-1",))


def test_vectors_that_were_tampered_with_are_found(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        _clean(memory)
        assert verify(ledger, embedding=memory.embedding).is_intact
        ledger._store.database.execute("UPDATE vector SET data = zeroblob(length(data)) WHERE seq = 1")
        ledger._store.database.execute("DELETE FROM vector WHERE seq = 3")
        found = verify(ledger, embedding=memory.embedding)
        assert (found.is_intact, found.vectors_wrong, found.chain.is_intact) == (False, 2, True)


def test_an_export_contains_every_memory(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        _clean(memory)
        out = list(export_rows(ledger, memory.state))
        assert [row["id"] for row in out] == list(memory.weights())
        assert [row["weight"] for row in out] == list(memory.weights().values())
        assert all(row["episode"]["contract"] and "judgement" not in row["episode"] for row in out)


def test_the_projection_preserves_distances_between_situations(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        assert project_memories(memory).points.shape == (0, 2)
        _clean(memory)
        projected = project_memories(memory)
        assert projected.points == pytest.approx(project_memories(memory).points)
        assert 0.3 < projected.explained_variance <= 1.0
        distances = np.linalg.norm(projected.points[:, None] - projected.points[None], axis=2)
        same = np.equal.outer(np.arange(12) % 4, np.arange(12) % 4)
        assert distances[same].max() < 1e-6 < distances[~same].min()


FOLLOWED, OTHER = _plan(1, speed=0.2), _plan(1, speed=0.4)


@pytest.mark.parametrize(
    ("chosen", "without", "used"),
    [
        (FOLLOWED, OTHER, True),
        (FOLLOWED, None, True),
        (FOLLOWED, FOLLOWED, False),
        (_plan(1, speed=0.205), OTHER, True),
        (_plan(2, speed=0.4), OTHER, False),
        ({**FOLLOWED, "action_sequence": FOLLOWED["action_sequence"] * 2}, OTHER, False),
        (None, OTHER, False),
        ({"action_sequence": [{"skill": "decline", "params": {"reason": "no"}}]}, OTHER, False),
    ],
)
def test_a_memory_counts_as_used_only_if_it_changed_the_contract_towards_its_own(
    chosen: Any, without: Any, used: bool
) -> None:
    assert was_used(FOLLOWED, chosen, ExclusionEffect(chosen, without)) == used


def test_utility_counts_contributing_memories() -> None:
    def use(succeeded: bool, Delta: float | None, reference: float | None) -> MemoryUse:
        return evaluate_use(
            "m",
            FOLLOWED,
            FOLLOWED,
            ExclusionEffect(FOLLOWED, OTHER),
            succeeded=succeeded,
            Delta=Delta,
            max_Delta=reference,
        )

    uses = [use(True, 0.001, 0.002), use(True, 0.003, 0.002), use(False, 0.001, 0.002), use(True, 0.5, None)]
    assert [one.contributing for one in uses] == [True, False, False, True]
    assert (summarize_uses(uses).rate, summarize_uses(uses).used, summarize_uses([]).rate) == (0.5, 4, None)


def test_an_audit_sums_up_the_use_of_memories(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        _clean(memory)
        assert audit(memory).utility.rate is None
        record_uses(
            ledger, "b-1", [MemoryUse("a-1", used=True, contributing=True), MemoryUse("a-2", True, False)], now=NOW
        )
        record_uses(ledger, "b-2", [MemoryUse("a-1", used=False, contributing=False)], now=NOW)
        found = audit(memory).utility
        assert (found.recalled, found.used, found.contributing) == (3, 2, 1)
        assert str(found) == "of 3 memories in prompts 2 were used, 1 contributed"


@pytest.mark.parametrize(
    ("agreeing", "opposing", "contradicted"), [(0, 1, False), (1, 1, False), (0, 2, True), (1, 3, True), (2, 3, False)]
)
def test_one_opposite_outcome_is_no_contradiction(
    tmp_path: Path, agreeing: int, opposing: int, contradicted: bool
) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        kinds: list[OutcomeClass] = ["succeeded"] * (1 + agreeing) + ["failed"] * opposing
        for i, kind in enumerate(kinds):
            memory.store(
                episode(f"e-{i}", kind, Delta=0.002, plan=_plan(0, speed=0.1 + i * 1e-4)), REST_POSTURE, now=NOW + i
            )
        assert ("e-0" in _kinds(memory, "label conflict")) == contradicted
