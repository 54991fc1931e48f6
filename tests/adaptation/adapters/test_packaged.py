"""What comes with dualbrain fits it: its card, its size, and the lessons it was taught, which can be drawn again."""

import pytest

from dualbrain.adaptation.adapters.base_models import base_model_hash
from dualbrain.adaptation.adapters.card import WEIGHTS_FILE, read_adapter_card
from dualbrain.adaptation.adapters.compatibility import require_compatible, require_same_prompt
from dualbrain.adaptation.adapters.packaged import packaged_folder, packaged_names
from dualbrain.adaptation.conversion.peft_lora import read_lora
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

LARGEST = 5_000_000
REGISTRIES = {robot: load_skill_registry(robot) for robot in ROBOT_SHARES}
MADE = {
    "base-135m": (SYNTHETIC_ADAPT_CONFIG, list(REGISTRIES)),
    "starter-135m": (starter_dataset.ADAPT_CONFIG, [ROBOT]),
}
"""By name: the dials, and the robots it was taught to speak to."""


@pytest.fixture(params=packaged_names())
def name(request):
    return request.param


@pytest.fixture
def card(name):
    return read_adapter_card(packaged_folder(name))


def test_the_base_of_the_main_table_is_here():
    assert "base-135m" in packaged_names()


def test_it_is_what_its_card_says(name, card):
    assert card.base_sha256 == base_model_hash(card.base)
    assert card.bootstrapped
    assert set(card.sources) == {"templates"}
    assert card.config == MADE[name][0]
    assert read_lora(packaged_folder(name))
    assert (packaged_folder(name) / WEIGHTS_FILE).stat().st_size <= LARGEST


def test_it_was_taught_todays_prompt_and_vocabularies(name, card):
    require_same_prompt(card)
    for robot in MADE[name][1]:
        require_compatible(card, robot, REGISTRIES[robot].hash)


@pytest.mark.slow
def test_the_lessons_of_the_base_can_be_drawn_again():
    again = build_synthetic_dataset(
        generate_examples(N_TRAIN_EXAMPLES, "teach"), generate_examples(N_CHECK_EXAMPLES, "check"), REGISTRIES
    )
    assert again.card.hash == read_adapter_card(packaged_folder("base-135m")).dataset
