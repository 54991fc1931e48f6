"""Questions from the known training data of either adapter are not asked; other training data is unknown."""

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

RECORDED, ELSEWHERE = "a" * 64, "e" * 64
"""An adapter that the ledger records, and the data set recorded with it."""


@pytest.fixture
def ledger(tmp_path):
    """A ledger of twelve memories that records an adapter trained on two of them."""
    with write_ledger(
        tmp_path,
        distinct_episodes(12),
        then=lambda memory: record_adapter(memory, RECORDED, ELSEWHERE, ["e3", "e7"], now=NOW),
    ) as opened:
        yield opened


@pytest.fixture
def dataset(ledger):
    return assemble_dataset(curate(ledger, REGISTRY, CurationConfig()), REGISTRY, CurationConfig())


@pytest.fixture
def card(tmp_path):
    """The card of an adapter with unknown training data."""
    return read_adapter_card(make_adapter(tmp_path / "made", "weights"))


def test_training_samples_of_one_of_the_two_are_left_out(dataset, card):
    both = (*dataset.train, *dataset.held_out)
    trained = msgspec.structs.replace(card, dataset=dataset.card.hash)
    assert (
        unseen_samples(both, [card, trained], dataset)
        == unseen_samples(both, [trained, card], dataset)
        == dataset.held_out
    )
    assert unseen_samples(both, [card], dataset) == both
    merged = msgspec.structs.replace(
        dataset.held_out[0], id="new", memory="new", others=(DuplicateSource(dataset.train[0].memory, "x"),)
    )
    assert unseen_samples([merged], [trained], dataset) == ()  # it also represents a training sample
    again = tuple(msgspec.structs.replace(row, memory="another") for row in dataset.train)
    assert unseen_samples(again, [trained], dataset) == ()  # the same question and answer in another data set


def test_questions_without_a_memory_are_not_taken_for_training_data(dataset, card):
    """Held-out questions and rehearsal examples of an exploration have no episode, so both have the memory ""."""
    trained = msgspec.structs.replace(card, dataset=dataset.card.hash)
    no_episode = [msgspec.structs.replace(row, memory="") for row in dataset.train]
    explored = msgspec.structs.replace(dataset, train=(*dataset.train, *no_episode))
    questions = tuple(msgspec.structs.replace(row, memory="") for row in dataset.held_out)
    assert unseen_samples(questions, [trained], explored) == questions
    assert unseen_samples(no_episode, [trained], explored) == ()


@pytest.mark.parametrize("known_by", [{"id": RECORDED}, {"dataset": ELSEWHERE}])
def test_memories_that_the_ledger_records_as_training_data_are_left_out(ledger, dataset, card, known_by):
    both = (*dataset.train, *dataset.held_out)
    recorded = msgspec.structs.replace(card, **known_by)
    kept = unseen_samples(both, [card, recorded], dataset, ledger)
    assert {row.memory for row in both} - {row.memory for row in kept} == {"e3", "e7"}
    assert unseen_samples(both, [card], dataset, ledger) == unseen_samples(both, [recorded], dataset) == both
