"""What comes with dualbrain fits it: its card, its size, and the lessons it was taught, which can be drawn again."""

import pytest

from dualbrain.adaptation.adapter_card import WEIGHTS, read_adapter_card
from dualbrain.adaptation.lessons.course import CHECKS, DIALS, LESSONS, course
from dualbrain.adaptation.serving.fitness import require_fit, require_prompt
from dualbrain.adaptation.serving.packaged import packaged_folder, packaged_names
from dualbrain.runtime.classroom import ROBOTS, lessons
from dualbrain.runtime.vocabulary import vocabulary
from dualbrain.weights import find_file

LARGEST = 5_000_000
REGISTRIES = {robot: vocabulary(robot) for robot in ROBOTS}


@pytest.fixture
def card():
    return read_adapter_card(packaged_folder("base-135m"))


def test_it_is_what_its_card_says(card):
    assert "base-135m" in packaged_names()
    assert card.base_sha256 == find_file(card.base).sha256
    assert card.bootstrapped
    assert set(card.sources) == {"templates"}
    assert card.config == DIALS
    assert (packaged_folder("base-135m") / WEIGHTS).stat().st_size <= LARGEST


def test_it_was_taught_todays_prompt_and_vocabularies(card):
    require_prompt(card)
    for robot, registry in REGISTRIES.items():
        require_fit(card, robot, registry.hash)


@pytest.mark.slow
def test_its_lessons_can_be_drawn_again(card):
    again = course(lessons(LESSONS, "teach"), lessons(CHECKS, "check"), REGISTRIES)
    assert again.card.hash == card.dataset
