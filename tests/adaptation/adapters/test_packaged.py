"""The packaged adapters match this version: their cards, sizes, and data sets, which can be generated again."""

import pytest

from dualbrain.adaptation.adapters.base_models import base_model_hash
from dualbrain.adaptation.adapters.card import WEIGHTS_FILE, read_adapter_card
from dualbrain.adaptation.adapters.compatibility import require_compatible, require_same_prompt
from dualbrain.adaptation.adapters.packaged import packaged_folder, packaged_names
from dualbrain.adaptation.config import AdaptConfig, FitConfig, ObjectiveConfig
from dualbrain.adaptation.conversion.peft_lora import read_lora
from dualbrain.adaptation.curation.curate import CurationConfig
from dualbrain.adaptation.curation.selection import CleanRules
from dualbrain.adaptation.synthetic.dataset import (
    N_CHECK_EXAMPLES,
    N_TRAIN_EXAMPLES,
    SYNTHETIC_ADAPT_CONFIG,
    build_synthetic_dataset,
)
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.runtime.data_collection import starter_dataset
from dualbrain.runtime.data_collection.rollouts import ROBOT
from dualbrain.runtime.data_collection.synthetic_scenes import ROBOT_SHARES, generate_examples

MAX_BYTES = 5_000_000
REGISTRIES = {robot: load_skill_registry(robot) for robot in ROBOT_SHARES}
EXPLORED_ADAPT_CONFIG = AdaptConfig(
    curation=CurationConfig(rules=CleanRules(epsilon=0.0021)),
    objective=ObjectiveConfig(lambda_h=0.0, beta=0.0, entropy_gate="none"),
    fit=FitConfig(steps=24, batch=16, at_once=2, warm_up=4, save_every=4, ask_at_most=0, keep="last", threads=1),
)
EXPECTED = {
    "base-135m": (SYNTHETIC_ADAPT_CONFIG, list(REGISTRIES), {"templates"}),
    "explored-135m": (EXPLORED_ADAPT_CONFIG, [ROBOT], {"templates", "value-model"}),
    "starter-135m": (starter_dataset.ADAPT_CONFIG, [ROBOT], {"templates"}),
}
"""By name: the settings, the robots in the training data, and what proposed its contracts."""


@pytest.fixture(params=packaged_names())
def name(request):
    return request.param


@pytest.fixture
def card(name):
    return read_adapter_card(packaged_folder(name))


def test_the_adapter_of_the_main_results_is_packaged():
    assert "base-135m" in packaged_names()


def test_a_packaged_adapter_agrees_with_its_card(name, card):
    assert card.base_sha256 == base_model_hash(card.base)
    assert card.bootstrapped
    assert set(card.sources) == EXPECTED[name][2]
    assert card.config == EXPECTED[name][0]
    assert read_lora(packaged_folder(name))
    assert (packaged_folder(name) / WEIGHTS_FILE).stat().st_size <= MAX_BYTES


def test_a_packaged_adapter_was_trained_with_the_present_prompt_and_vocabularies(name, card):
    require_same_prompt(card)
    for robot in EXPECTED[name][1]:
        require_compatible(card, robot, REGISTRIES[robot].hash)


@pytest.mark.slow
def test_the_examples_of_the_base_can_be_generated_again():
    again = build_synthetic_dataset(
        generate_examples(N_TRAIN_EXAMPLES, "teach"), generate_examples(N_CHECK_EXAMPLES, "check"), REGISTRIES
    )
    assert again.card.hash == read_adapter_card(packaged_folder("base-135m")).dataset
