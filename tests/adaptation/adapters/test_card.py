"""The card of an adapter: read back as written, refused beside other weights."""

import pytest

from dualbrain.adaptation.adapters.card import (
    WEIGHTS,
    AdapterCard,
    proposed_by_others,
    read_adapter_card,
    weights_id,
    write_card,
)
from dualbrain.adaptation.config import AdaptConfig
from dualbrain.errors import InvalidSetup, MissingPart


@pytest.fixture
def folder(tmp_path):
    (tmp_path / WEIGHTS).write_bytes(b"some weights")
    card = AdapterCard(
        weights_id(tmp_path), "smollm2", "b" * 64, "panda", "r", "p", "d", {"smollm2": 3}, False, "float32", 7, None,
        AdaptConfig(), {"torch": "2"},
    )  # fmt: skip
    write_card(card, tmp_path)
    return tmp_path


def test_it_comes_back_as_it_was(folder):
    card = read_adapter_card(folder)
    assert card.id == weights_id(folder)
    write_card(card, folder)
    assert read_adapter_card(folder) == card


def test_other_weights_or_a_broken_card_are_refused(folder):
    (folder / "adapter.json").write_text("{")
    with pytest.raises(InvalidSetup, match="adapter card"):
        read_adapter_card(folder)


def test_weights_that_were_changed_are_refused(folder):
    (folder / WEIGHTS).write_bytes(b"other weights")
    with pytest.raises(InvalidSetup, match="do not use"):
        read_adapter_card(folder)
    (folder / WEIGHTS).unlink()
    with pytest.raises(MissingPart):
        read_adapter_card(folder)


@pytest.mark.parametrize(
    ("sources", "by_others"),
    [
        ({}, False),
        ({"smollm2": 3}, False),
        ({"smollm2": 3, "smollm2+0123456789abcdef": 4}, False),
        ({"smollm2": 3, "smollm2+ab12": 4}, True),  # an adapter of whose teachers nothing is known
        ({"smollm2 in torch": 3, "smollm2": 1}, False),
        ({"smollm2-large in torch": 3}, True),
        ({"smollm2+big": 4}, True),
        ({"smollm2": 3, "qwen": 1}, True),
        ({"smollm2-large": 1}, True),
    ],
)
def test_what_others_proposed_makes_it_bootstrapped(sources, by_others):
    assert proposed_by_others(sources, "smollm2", own=["0123456789abcdef" * 4]) is by_others
