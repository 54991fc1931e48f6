"""The starter data set: settings of its cycle, and differences from a stored data set in words."""

from types import SimpleNamespace

import msgspec
import pytest

from dualbrain.adaptation.adapters.card import has_foreign_proposals
from dualbrain.adaptation.curation.dataset import DatasetCard
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.planner.prompt.short_prompt import short_template_hash
from dualbrain.runtime.data_collection import starter_dataset
from dualbrain.runtime.data_collection.exploration import cycle
from dualbrain.runtime.data_collection.exploration.proposals import SOURCE
from dualbrain.runtime.data_collection.rollouts import EPSILON

CARD = DatasetCard(
    hash="a" * 64,
    form="conversational prompt-completion, JSON lines",
    robot="panda",
    registry=load_skill_registry("panda").hash,
    prompt=short_template_hash(),
    ledger="",
    event=0,
    memories=0,
    train=0,
    held_out=0,
    shown=0,
    scenes=0,
    merged=0,
    left_out={},
    sources={SOURCE: 4, "templates": 2},
    epsilon=EPSILON,
    slowest=1.5,
    most_repeats=1,
    share_held_out=0.1,
    salt="",
    scene_values=True,
)
DIFFERENCES = {
    "form": ({"form": "another"}, "form another, now conversational"),
    "robot": ({"robot": "ur5e"}, "robot ur5e, now panda"),
    "vocabulary": ({"registry": "00000000"}, "registry 00000000, now "),
    "prompt": ({"prompt": "0" * 16}, f"prompt {'0' * 16}, now "),
    "site": ({"site": "a" * 64}, f"site {'a' * 64}, now "),
    "summary": ({"scene_values": False}, "scene_values False, now True"),
}


@pytest.mark.parametrize("part", DIFFERENCES)
def test_a_data_set_for_something_else_is_named(tmp_path, part):
    changed, words = DIFFERENCES[part]
    assert words in cycle.dataset_difference(msgspec.structs.replace(CARD, **changed), starter_dataset.CYCLE, tmp_path)


def test_a_data_set_without_its_executions_is_named(tmp_path):
    assert "value_model.json" in cycle.dataset_difference(CARD, starter_dataset.CYCLE, tmp_path)


def test_samples_that_were_made_differently_are_named(tmp_path, monkeypatch):
    now = msgspec.structs.replace(CARD, hash="b" * 64)
    monkeypatch.setattr(cycle, "build_cycle_dataset", lambda config, folder: SimpleNamespace(card=now))
    assert cycle.dataset_difference(CARD, starter_dataset.CYCLE, tmp_path) == f"samples {'a' * 16}, now {'b' * 16}"
    assert cycle.dataset_difference(now, starter_dataset.CYCLE, tmp_path) == ""


def test_the_proposals_are_foreign_to_the_base():
    assert has_foreign_proposals(CARD.sources, starter_dataset.BASE_MODEL)
    assert starter_dataset.CYCLE.adapt.curation.rules.epsilon == EPSILON
