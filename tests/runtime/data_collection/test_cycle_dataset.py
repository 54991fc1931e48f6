"""Differences between a stored data set and that of a cycle, in words."""

from types import SimpleNamespace

import msgspec
import pytest

from dualbrain.adaptation.curation.dataset import DatasetCard
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.planner.prompt.short_prompt import short_template_hash
from dualbrain.runtime.data_collection.exploration import cycle
from dualbrain.runtime.data_collection.exploration.cycle import CycleConfig
from dualbrain.runtime.data_collection.exploration.proposals import SOURCE

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
    epsilon=0.003,
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
    assert words in cycle.dataset_difference(msgspec.structs.replace(CARD, **changed), CycleConfig(), tmp_path)


def test_a_data_set_without_its_executions_is_named(tmp_path):
    assert "value_model.json" in cycle.dataset_difference(CARD, CycleConfig(), tmp_path)


def test_samples_that_were_made_differently_are_named(tmp_path, monkeypatch):
    now = msgspec.structs.replace(CARD, hash="b" * 64)
    monkeypatch.setattr(cycle, "build_cycle_dataset", lambda config, folder: SimpleNamespace(card=now))
    assert cycle.dataset_difference(CARD, CycleConfig(), tmp_path) == f"samples {'a' * 16}, now {'b' * 16}"
    assert cycle.dataset_difference(now, CycleConfig(), tmp_path) == ""
