"""The first night: what chance proposed and went well, declines by their label, an adapter that calls itself so."""

import pytest

from dualbrain.adaptation.adapters.card import has_foreign_proposals
from dualbrain.adaptation.curation.sample import encode_samples
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.runtime.data_collection import starter_dataset
from dualbrain.runtime.data_collection.rollouts import (
    LEDGER_FILE,
    PROPOSALS_FILE,
    draw_proposals,
    is_declined,
    memory_id_of_turn,
    turn_of_memory_id,
)
from tests.adaptation.sample_episodes import episode, pick_contract, summary, write_ledger

DECLINE = pick_contract() | {"action_sequence": [{"skill": "decline", "params": {"reason": "no skill can do this"}}]}
LOUD = 7


@pytest.fixture(scope="module")
def drawn():
    return draw_proposals(starter_dataset.SEED, 80, include_declines=True)


@pytest.fixture
def day(drawn, tmp_path):
    """A day that was not flown: each turn in a scene of its own; every seventh deed is declined, others are loud."""
    told = [_ended(turn, one) for turn, one in enumerate(drawn)]
    write_ledger(tmp_path, told).close()
    (tmp_path / PROPOSALS_FILE).write_bytes(encode_samples(drawn))
    return tmp_path


def _ended(turn, one):
    same = {"by": one.source, "told": summary(number=turn), "words": f"errand {turn}"}
    if is_declined(one) or turn % LOUD == 0:
        return episode(memory_id_of_turn(turn), "declined", Delta=None, duration=0.0, plan=DECLINE, **same)
    return episode(memory_id_of_turn(turn), Delta=0.1 if turn % LOUD == 1 else 0.001, **same)


def test_deeds_teach_by_verdict_and_declines_by_their_lesson(day, drawn):
    data = starter_dataset.build_dataset(day)
    turns = {turn_of_memory_id(row.memory) for row in (*data.train, *data.held_out)}
    deeds = {turn for turn, one in enumerate(drawn) if not is_declined(one) and turn % LOUD > 1}
    declines = [turn for turn, one in enumerate(drawn) if is_declined(one)]
    assert turns - set(declines) == deeds
    assert turns & set(declines) == set(declines[: len(deeds) // starter_dataset.SUCCESSES_PER_DECLINE])
    assert turns & set(declines)


def test_it_is_taught_by_somebody_else_and_says_so(day):
    data = starter_dataset.build_dataset(day)
    assert set(data.card.sources) == {"templates"}
    assert has_foreign_proposals(data.card.sources, starter_dataset.BASE_MODEL)
    assert data.card.robot == "panda"
    with LedgerReader(day / LEDGER_FILE) as ledger:
        assert data.card.ledger == ledger.head().hash
