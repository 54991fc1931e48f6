"""What comes with dualbrain fits it: its card, its size, and the lessons it was taught, which can be drawn again."""

import pytest

from dualbrain.adaptation.adapters.base_models import hash_of_base
from dualbrain.adaptation.adapters.card import WEIGHTS, read_adapter_card
from dualbrain.adaptation.adapters.compatibility import require_fit, require_prompt
from dualbrain.adaptation.adapters.packaged import packaged_folder, packaged_names
from dualbrain.adaptation.conversion.peft_lora import read_lora
from dualbrain.adaptation.synthetic.dataset import CHECKS, DIALS, LESSONS, course
from dualbrain.grounding.vocabulary import vocabulary
from dualbrain.runtime.data_collection import starter_dataset
from dualbrain.runtime.data_collection.rollouts import ROBOT
from dualbrain.runtime.data_collection.synthetic_scenes import ROBOTS, lessons

LARGEST = 5_000_000
REGISTRIES = {robot: vocabulary(robot) for robot in ROBOTS}
MADE = {"base-135m": (DIALS, list(REGISTRIES)), "starter-135m": (starter_dataset.DIALS, [ROBOT])}
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
    assert card.base_sha256 == hash_of_base(card.base)
    assert card.bootstrapped
    assert set(card.sources) == {"templates"}
    assert card.config == MADE[name][0]
    assert read_lora(packaged_folder(name))
    assert (packaged_folder(name) / WEIGHTS).stat().st_size <= LARGEST


def test_it_was_taught_todays_prompt_and_vocabularies(name, card):
    require_prompt(card)
    for robot in MADE[name][1]:
        require_fit(card, robot, REGISTRIES[robot].hash)


@pytest.mark.slow
def test_the_lessons_of_the_base_can_be_drawn_again():
    again = course(lessons(LESSONS, "teach"), lessons(CHECKS, "check"), REGISTRIES)
    assert again.card.hash == read_adapter_card(packaged_folder("base-135m")).dataset
