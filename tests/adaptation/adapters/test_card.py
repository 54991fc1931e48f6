"""The card of an adapter: read back as written, rejected beside other weights."""

import pytest

from dualbrain.adaptation.adapters.card import (
    WEIGHTS_FILE,
    AdapterCard,
    has_foreign_proposals,
    hash_weights,
    read_adapter_card,
    write_adapter_card,
)
from dualbrain.adaptation.config import AdaptConfig
from dualbrain.errors import ConfigurationError, MissingDependencyError


@pytest.fixture
def folder(tmp_path):
    (tmp_path / WEIGHTS_FILE).write_bytes(b"some weights")
    card = AdapterCard(
        id=hash_weights(tmp_path),
        base="smollm2",
        base_sha256="b" * 64,
        robot="panda",
        registry="r",
        prompt="p",
        dataset="d",
        sources={"smollm2": 3},
        bootstrapped=False,
        precision="float32",
        steps=7,
        held_out=None,
        config=AdaptConfig(),
        versions={"torch": "2"},
    )
    write_adapter_card(card, tmp_path)
    return tmp_path


def test_a_card_is_read_back_as_written(folder):
    card = read_adapter_card(folder)
    assert card.id == hash_weights(folder)
    write_adapter_card(card, folder)
    assert read_adapter_card(folder) == card


def test_a_broken_card_is_rejected(folder):
    (folder / "adapter.json").write_text("{")
    with pytest.raises(ConfigurationError, match="adapter card"):
        read_adapter_card(folder)


def test_changed_weights_are_rejected(folder):
    (folder / WEIGHTS_FILE).write_bytes(b"other weights")
    with pytest.raises(ConfigurationError, match="Do not use"):
        read_adapter_card(folder)
    (folder / WEIGHTS_FILE).unlink()
    with pytest.raises(MissingDependencyError):
        read_adapter_card(folder)


@pytest.mark.parametrize(
    ("sources", "by_others"),
    [
        ({}, False),
        ({"smollm2": 3}, False),
        ({"smollm2": 3, "smollm2+0123456789abcdef": 4}, False),
        ({"smollm2": 3, "smollm2+ab12": 4}, True),  # an adapter with unknown training data
        ({"smollm2 in torch": 3, "smollm2": 1}, False),
        ({"smollm2-large in torch": 3}, True),
        ({"smollm2+big": 4}, True),
        ({"smollm2": 3, "qwen": 1}, True),
        ({"smollm2-large": 1}, True),
    ],
)
def test_proposals_of_other_planners_make_an_adapter_bootstrapped(sources, by_others):
    assert has_foreign_proposals(sources, "smollm2", own_adapters=["0123456789abcdef" * 4]) is by_others
