"""What is known to have taught either adapter is not asked; of what was taught elsewhere nothing is known."""

import msgspec
import pytest

from dualbrain.adaptation.adapters.card import read_adapter_card
from dualbrain.adaptation.adapters.training_overlap import unseen_samples
from dualbrain.adaptation.curation.curate import CurationConfig, curate
from dualbrain.adaptation.curation.dataset import assemble_dataset
from dualbrain.adaptation.curation.sample import DuplicateSource
from dualbrain.memory.maintenance.edits import record_adapter
from tests.adaptation.adapters.test_registry import make_adapter
from tests.adaptation.sample_episodes import NOW, REGISTRY, distinct_episodes, write_ledger

NOTED, ELSEWHERE = "a" * 64, "e" * 64
"""An adapter that the ledger knows, and a data set that it names with it."""


@pytest.fixture
def ledger(tmp_path):
    """A ledger of twelve memories; it says that an adapter was taught two of them."""
    with write_ledger(
        tmp_path,
        distinct_episodes(12),
        then=lambda memory: record_adapter(memory, NOTED, ELSEWHERE, ["e3", "e7"], now=NOW),
    ) as opened:
        yield opened


@pytest.fixture
def dataset(ledger):
    return assemble_dataset(curate(ledger, REGISTRY, CurationConfig()), REGISTRY, CurationConfig())


@pytest.fixture
def card(tmp_path):
    """The card of an adapter of which nothing is known here."""
    return read_adapter_card(make_adapter(tmp_path / "made", "weights"))


def test_what_the_data_set_taught_one_of_the_two_is_left_out(dataset, card):
    both = (*dataset.train, *dataset.held_out)
    taught = msgspec.structs.replace(card, dataset=dataset.card.hash)
    assert (
        unseen_samples(both, [card, taught], dataset)
        == unseen_samples(both, [taught, card], dataset)
        == dataset.held_out
    )
    assert unseen_samples(both, [card], dataset) == both
    merged = msgspec.structs.replace(
        dataset.held_out[0], id="new", memory="new", others=(DuplicateSource(dataset.train[0].memory, "x"),)
    )
    assert unseen_samples([merged], [taught], dataset) == ()  # it also stands for what was taught
    again = tuple(msgspec.structs.replace(row, memory="another") for row in dataset.train)
    assert unseen_samples(again, [taught], dataset) == ()  # the same question and answer, of another night


@pytest.mark.parametrize("known_by", [{"id": NOTED}, {"dataset": ELSEWHERE}])
def test_what_the_ledger_says_that_it_was_taught_is_left_out(ledger, dataset, card, known_by):
    both = (*dataset.train, *dataset.held_out)
    noted = msgspec.structs.replace(card, **known_by)
    kept = unseen_samples(both, [card, noted], dataset, ledger)
    assert {row.memory for row in both} - {row.memory for row in kept} == {"e3", "e7"}
    assert unseen_samples(both, [card], dataset, ledger) == unseen_samples(both, [noted], dataset) == both
