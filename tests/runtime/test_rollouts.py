"""Proposals: drawn by seed, carried out by turn, and the same ledger however often it was stopped."""

import itertools
import json

import msgspec
import pytest

from dualbrain.adaptation.curation.sample import assistant_turn
from dualbrain.cli.common import paths
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.state.derivation import derive_state
from dualbrain.runtime.data_collection import rollouts as room
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


def test_proposals_ask_for_deeds_and_differ_by_seed():
    some, others = draw_proposals(0, 4), draw_proposals(1, 4)
    assert len(some) == len(others) == 4
    assert not {one.id for one in some} & {one.id for one in others}
    for one in some:
        assert "<example>" not in one.prompt[-1]["content"]
        assert '"decline"' not in one.contract
        assert instruction_of(one)


def test_what_cannot_be_done_is_among_them_only_where_it_is_wanted():
    some = draw_proposals(0, 40, include_declines=True)
    assert 0 < sum(map(is_declined, some)) < 20
    assert draw_proposals(0, 12) == tuple(one for one in some if not is_declined(one))[:12]


@pytest.fixture(scope="module")
def wanted():
    return draw_proposals(0, 8)


@pytest.fixture
def unflown(monkeypatch):
    """Nothing flies; a ledger is a line a turn. Returns the turns that were carried out."""
    turns = []

    def note(one, ledger, turn, *, cache):
        turns.append(turn)
        with ledger.open("a") as lines:
            lines.write(f"{turn} {one.source}\n")
        return episode(memory_id_of_turn(turn))

    monkeypatch.setattr(room, "run_proposal", note)
    monkeypatch.setattr(room, "EPISODES_PER_STEP", 3)
    return turns


@pytest.mark.parametrize("after", [0, 2, 3, 7])
def test_stopped_after_any_flight_it_ends_with_the_same_ledger(unflown, wanted, tmp_path, after):
    whole = run_proposals(tmp_path / "whole", 8, wanted.__getitem__, cache=tmp_path)
    left = itertools.count(-after)

    def stops(turn):
        if next(left) == 0:
            raise KeyboardInterrupt
        return wanted[turn]

    with pytest.raises(KeyboardInterrupt):
        run_proposals(tmp_path / "again", 8, stops, cache=tmp_path)
    unflown.clear()
    again = run_proposals(tmp_path / "again", 8, wanted.__getitem__, cache=tmp_path)
    assert unflown == list(range(after - after % 3, 8))
    for name in (room.LEDGER_FILE, room.PROPOSALS_FILE):
        assert (again / name).read_bytes() == (whole / name).read_bytes()
    assert room.load_proposals(again) == wanted


def test_a_day_goes_on_from_another_one(unflown, wanted, tmp_path):
    done = []
    first = run_proposals(tmp_path / "first", 4, wanted.__getitem__, cache=tmp_path)
    both = run_proposals(
        tmp_path / "second",
        4,
        wanted.__getitem__,
        cache=tmp_path,
        first_turn=4,
        initial_folder=first,
        on_episode=lambda count, episode: done.append((count, episode.id)),
    )
    assert room.load_proposals(both) == wanted
    assert room.load_proposals(first) == wanted[:4]
    assert done == [(count, memory_id_of_turn(3 + count)) for count in (1, 2, 3, 4)]
    assert turn_of_memory_id(memory_id_of_turn(17)) == 17


@pytest.mark.llm
def test_a_ledger_depends_on_the_proposals_alone(tmp_path):
    """Flown for good: a decline moves nothing, a wait does; each is remembered under who proposed it."""
    refusal = next(one for one in draw_proposals(0, 40, include_declines=True) if is_declined(one))
    told = json.loads(refusal.contract) | {"action_sequence": [{"skill": "hold", "params": {"duration": 0.5}}]}
    wait = msgspec.structs.replace(refusal, completion=assistant_turn(json.dumps(told)), source="somebody")
    heads = []
    for name in ("one", "other"):
        ledger = tmp_path / name / room.LEDGER_FILE
        ended = [
            run_proposal(one, ledger, turn, cache=paths.cache_folder()) for turn, one in enumerate((refusal, wait))
        ]
        assert [one.outcome.kind for one in ended] == ["declined", "succeeded"]
        with LedgerReader(ledger) as reader:
            heads.append(reader.head())
            assert [memo.provenance.source for memo in derive_state(reader).memories] == ["templates", "somebody"]
    assert heads[0] == heads[1]
