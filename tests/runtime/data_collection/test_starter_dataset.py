"""The starter data set: random proposals that succeeded, declines by their label, and the sources on the card."""

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
CYCLE = 7


@pytest.fixture(scope="module")
def drawn():
    return draw_proposals(starter_dataset.SEED, 80, include_declines=True)


@pytest.fixture
def rollouts(drawn, tmp_path):
    """Rollouts that were not simulated: of seven successes, one is declined and one has a large Δ."""
    episodes = [make_episode(turn, one) for turn, one in enumerate(drawn)]
    write_ledger(tmp_path, episodes).close()
    (tmp_path / PROPOSALS_FILE).write_bytes(encode_samples(drawn))
    return tmp_path


def make_episode(turn, one):
    common = {
        "proposer": one.source,
        "scene_summary": summary(number=turn),
        "instruction": f"instruction {turn}",
    }
    if is_declined(one) or turn % CYCLE == 0:
        return episode(memory_id_of_turn(turn), "declined", Delta=None, duration=0.0, plan=DECLINE, **common)
    return episode(memory_id_of_turn(turn), Delta=0.1 if turn % CYCLE == 1 else 0.001, **common)


def test_successes_are_selected_by_verdict_and_declines_by_their_label(rollouts, drawn):
    data = starter_dataset.build_dataset(rollouts)
    turns = {turn_of_memory_id(row.memory) for row in (*data.train, *data.held_out)}
    successes = {turn for turn, one in enumerate(drawn) if not is_declined(one) and turn % CYCLE > 1}
    declines = [turn for turn, one in enumerate(drawn) if is_declined(one)]
    assert turns - set(declines) == successes
    assert turns & set(declines) == set(declines[: len(successes) // starter_dataset.SUCCESSES_PER_DECLINE])
    assert turns & set(declines)


def test_the_card_names_the_foreign_source_of_the_proposals(rollouts):
    data = starter_dataset.build_dataset(rollouts)
    assert set(data.card.sources) == {"templates"}
    assert has_foreign_proposals(data.card.sources, starter_dataset.BASE_MODEL)
    assert data.card.robot == "panda"
    with LedgerReader(rollouts / LEDGER_FILE) as ledger:
        assert data.card.ledger == ledger.head().hash
