"""Rollouts: proposals are drawn by seed and executed by turn, and an interrupted run ends with the same ledger."""

import itertools
import json

import msgspec
import pytest

from dualbrain.adaptation.curation.sample import assistant_turn
from dualbrain.core import paths
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.state.derivation import derive_state
from dualbrain.runtime.data_collection import rollouts
from dualbrain.runtime.data_collection.rollouts import (
    draw_proposals,
    instruction_of,
    is_declined,
    memory_id_of_turn,
    run_proposal,
    run_proposals,
    turn_of_memory_id,
)
from tests.adaptation.sample_episodes import episode


def test_proposals_are_feasible_and_differ_by_seed():
    some, others = draw_proposals(0, 4), draw_proposals(1, 4)
    assert len(some) == len(others) == 4
    assert not {one.id for one in some} & {one.id for one in others}
    for one in some:
        assert "<example>" not in one.prompt[-1]["content"]
        assert '"decline"' not in one.contract
        assert instruction_of(one)


def test_declines_are_only_proposed_on_request():
    some = draw_proposals(0, 40, include_declines=True)
    assert 0 < sum(map(is_declined, some)) < 20
    assert draw_proposals(0, 12) == tuple(one for one in some if not is_declined(one))[:12]


@pytest.fixture(scope="module")
def proposals():
    return draw_proposals(0, 8)


@pytest.fixture
def executed_turns(monkeypatch):
    """The turns of the proposals that were executed; nothing is simulated, and a ledger has a line per turn."""
    turns = []

    def record(one, ledger, turn, *, cache):
        turns.append(turn)
        with ledger.open("a") as lines:
            lines.write(f"{turn} {one.source}\n")
        return episode(memory_id_of_turn(turn))

    monkeypatch.setattr(rollouts, "run_proposal", record)
    monkeypatch.setattr(rollouts, "EPISODES_PER_STEP", 3)
    return turns


@pytest.mark.parametrize("after", [0, 2, 3, 7])
def test_a_run_that_was_interrupted_after_any_episode_ends_with_the_same_ledger(
    executed_turns, proposals, tmp_path, after
):
    complete = run_proposals(tmp_path / "complete", 8, proposals.__getitem__, cache=tmp_path)
    remaining = itertools.count(-after)

    def propose_or_interrupt(turn):
        if next(remaining) == 0:
            raise KeyboardInterrupt
        return proposals[turn]

    with pytest.raises(KeyboardInterrupt):
        run_proposals(tmp_path / "resumed", 8, propose_or_interrupt, cache=tmp_path)
    executed_turns.clear()
    resumed = run_proposals(tmp_path / "resumed", 8, proposals.__getitem__, cache=tmp_path)
    assert executed_turns == list(range(after - after % 3, 8))
    for name in (rollouts.LEDGER_FILE, rollouts.PROPOSALS_FILE):
        assert (resumed / name).read_bytes() == (complete / name).read_bytes()
    assert rollouts.load_proposals(resumed) == proposals


@pytest.mark.usefixtures("executed_turns")
def test_a_run_continues_the_folder_of_another_one(proposals, tmp_path):
    done = []
    first = run_proposals(tmp_path / "first", 4, proposals.__getitem__, cache=tmp_path)
    both = run_proposals(
        tmp_path / "second",
        4,
        proposals.__getitem__,
        cache=tmp_path,
        first_turn=4,
        initial_folder=first,
        on_episode=lambda count, episode: done.append((count, episode.id)),
    )
    assert rollouts.load_proposals(both) == proposals
    assert rollouts.load_proposals(first) == proposals[:4]
    assert done == [(count, memory_id_of_turn(3 + count)) for count in (1, 2, 3, 4)]
    assert turn_of_memory_id(memory_id_of_turn(17)) == 17


@pytest.mark.llm
def test_a_ledger_depends_on_the_proposals_alone(tmp_path):
    """Both executions of a decline and a hold give the same ledger; each memory has the source of its proposal."""
    refusal = next(one for one in draw_proposals(0, 40, include_declines=True) if is_declined(one))
    hold = json.loads(refusal.contract) | {"action_sequence": [{"skill": "hold", "params": {"duration": 0.5}}]}
    wait = msgspec.structs.replace(refusal, completion=assistant_turn(json.dumps(hold)), source="person")
    heads = []
    for name in ("one", "other"):
        ledger = tmp_path / name / rollouts.LEDGER_FILE
        ended = [
            run_proposal(one, ledger, turn, cache=paths.cache_folder()) for turn, one in enumerate((refusal, wait))
        ]
        assert [one.outcome.kind for one in ended] == ["declined", "succeeded"]
        with LedgerReader(ledger) as reader:
            heads.append(reader.head())
            assert [memory.provenance.source for memory in derive_state(reader).memories] == ["templates", "person"]
    assert heads[0] == heads[1]
