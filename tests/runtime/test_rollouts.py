"""Proposals: drawn by seed, carried out by turn, and the same ledger however often it was stopped."""

import itertools
import json

import msgspec
import pytest

from dualbrain.adaptation.curation.sample import answer
from dualbrain.cli.common import paths
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.state.derivation import derive
from dualbrain.runtime.data_collection import rollouts as room
from dualbrain.runtime.data_collection.rollouts import (
    carried_out,
    declined,
    flown,
    instruction_of,
    memory_of,
    proposals,
    turn_of,
)
from tests.adaptation.sample_episodes import episode


def test_proposals_ask_for_deeds_and_differ_by_seed():
    some, others = proposals(0, 4), proposals(1, 4)
    assert len(some) == len(others) == 4
    assert not {one.id for one in some} & {one.id for one in others}
    for one in some:
        assert "<example>" not in one.prompt[-1]["content"]
        assert '"decline"' not in one.contract
        assert instruction_of(one)


def test_what_cannot_be_done_is_among_them_only_where_it_is_wanted():
    some = proposals(0, 40, declines=True)
    assert 0 < sum(map(declined, some)) < 20
    assert proposals(0, 12) == tuple(one for one in some if not declined(one))[:12]


@pytest.fixture(scope="module")
def wanted():
    return proposals(0, 8)


@pytest.fixture
def unflown(monkeypatch):
    """Nothing flies; a ledger is a line a turn. Returns the turns that were carried out."""
    turns = []

    def note(one, ledger, turn, *, cache):
        turns.append(turn)
        with ledger.open("a") as lines:
            lines.write(f"{turn} {one.source}\n")
        return episode(memory_of(turn))

    monkeypatch.setattr(room, "carried_out", note)
    monkeypatch.setattr(room, "TOGETHER", 3)
    return turns


@pytest.mark.parametrize("after", [0, 2, 3, 7])
def test_stopped_after_any_flight_it_ends_with_the_same_ledger(unflown, wanted, tmp_path, after):
    whole = flown(tmp_path / "whole", 8, wanted.__getitem__, cache=tmp_path)
    left = itertools.count(-after)

    def stops(turn):
        if next(left) == 0:
            raise KeyboardInterrupt
        return wanted[turn]

    with pytest.raises(KeyboardInterrupt):
        flown(tmp_path / "again", 8, stops, cache=tmp_path)
    unflown.clear()
    again = flown(tmp_path / "again", 8, wanted.__getitem__, cache=tmp_path)
    assert unflown == list(range(after - after % 3, 8))
    for name in (room.LEDGER, room.LINES):
        assert (again / name).read_bytes() == (whole / name).read_bytes()
    assert room.proposed(again) == wanted


def test_a_day_goes_on_from_another_one(unflown, wanted, tmp_path):
    done = []
    first = flown(tmp_path / "first", 4, wanted.__getitem__, cache=tmp_path)
    both = flown(
        tmp_path / "second", 4, wanted.__getitem__, cache=tmp_path, first=4, start=first,
        tell=lambda count, episode: done.append((count, episode.id)),
    )  # fmt: skip
    assert room.proposed(both) == wanted
    assert room.proposed(first) == wanted[:4]
    assert done == [(count, memory_of(3 + count)) for count in (1, 2, 3, 4)]
    assert turn_of(memory_of(17)) == 17


@pytest.mark.llm
def test_a_ledger_depends_on_the_proposals_alone(tmp_path):
    """Flown for good: a decline moves nothing, a wait does; each is remembered under who proposed it."""
    refusal = next(one for one in proposals(0, 40, declines=True) if declined(one))
    told = json.loads(refusal.contract) | {"action_sequence": [{"skill": "hold", "params": {"duration": 0.5}}]}
    wait = msgspec.structs.replace(refusal, completion=answer(json.dumps(told)), source="somebody")
    heads = []
    for name in ("one", "other"):
        ledger = tmp_path / name / room.LEDGER
        ended = [carried_out(one, ledger, turn, cache=paths.cache()) for turn, one in enumerate((refusal, wait))]
        assert [one.outcome.kind for one in ended] == ["declined", "succeeded"]
        with LedgerReader(ledger) as reader:
            heads.append(reader.head())
            assert [memo.provenance.source for memo in derive(reader).memos] == ["templates", "somebody"]
    assert heads[0] == heads[1]
