"""The first night: what chance proposed and went well, declines by their label, an adapter that calls itself so."""

import pytest

from dualbrain.adaptation.adapters.card import proposed_by_others
from dualbrain.adaptation.curation.sample import to_lines
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.runtime.data_collection import starter_dataset
from dualbrain.runtime.data_collection.rollouts import LEDGER, LINES, declined, memory_of, proposals, turn_of
from tests.adaptation.sample_episodes import episode, pick, remember, summary

DECLINE = pick() | {"action_sequence": [{"skill": "decline", "params": {"reason": "no skill can do this"}}]}
LOUD = 7


@pytest.fixture(scope="module")
def drawn():
    return proposals(starter_dataset.SEED, 80, declines=True)


@pytest.fixture
def day(drawn, tmp_path):
    """A day that was not flown: each turn in a scene of its own; every seventh deed is declined, others are loud."""
    told = [_ended(turn, one) for turn, one in enumerate(drawn)]
    remember(tmp_path, told).close()
    (tmp_path / LINES).write_bytes(to_lines(drawn))
    return tmp_path


def _ended(turn, one):
    same = {"by": one.source, "told": summary(number=turn), "words": f"errand {turn}"}
    if declined(one) or turn % LOUD == 0:
        return episode(memory_of(turn), "declined", Delta=None, duration=0.0, plan=DECLINE, **same)
    return episode(memory_of(turn), Delta=0.1 if turn % LOUD == 1 else 0.001, **same)


def test_deeds_teach_by_verdict_and_declines_by_their_lesson(day, drawn):
    data = starter_dataset.taught(day)
    turns = {turn_of(row.memory) for row in (*data.train, *data.held_out)}
    deeds = {turn for turn, one in enumerate(drawn) if not declined(one) and turn % LOUD > 1}
    declines = [turn for turn, one in enumerate(drawn) if declined(one)]
    assert turns - set(declines) == deeds
    assert turns & set(declines) == set(declines[: len(deeds) // starter_dataset.DEEDS_A_DECLINE])
    assert turns & set(declines)


def test_it_is_taught_by_somebody_else_and_says_so(day):
    data = starter_dataset.taught(day)
    assert set(data.card.sources) == {"templates"}
    assert proposed_by_others(data.card.sources, starter_dataset.BASE)
    assert data.card.robot == "panda"
    with LedgerReader(day / LEDGER) as ledger:
        assert data.card.ledger == ledger.head().hash
