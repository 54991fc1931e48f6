"""The planner `value:FILE`: its contracts are the alternatives of the value model, taken from the text of the scene."""

import msgspec
import numpy as np
import pytest

from dualbrain.adaptation.value_model.symbols import Placement
from dualbrain.adaptation.value_model.value_model import ExecutedSiblings, fit_value_model, save_value_model
from dualbrain.errors import ConfigurationError
from dualbrain.evaluation.planners.value_planner import VALUE_PREFIX, load_value_planner, value_model_digest
from dualbrain.grounding.alternatives import CHANGED_LEVELS
from dualbrain.runtime.data_collection.exploration.explore import nth_place
from dualbrain.runtime.data_collection.exploration.proposals import draw_sentence, make_sample
from dualbrain.runtime.data_collection.rollouts import build_request


@pytest.fixture
def place():
    """A placement into the container, whose path the summary describes."""
    places = (nth_place("panda", "teach", 11, index) for index in range(50))
    return next(one for one in places if one.placement.destination == "blue_bowl")


def planner_that_prefers(name, tmp_path, place):
    """The planner of a value model for which `name` is the best alternative everywhere."""
    rng = np.random.default_rng(0)
    siblings = [
        ExecutedSiblings(
            Placement(place.summary, place.placement.object_name, "blue_bowl"),
            {one: float(one == name) + 0.01 * rng.random() for one in CHANGED_LEVELS},
        )
        for _ in range(10)
    ]
    save_value_model(fit_value_model(siblings), tmp_path / f"{name}.json")
    return load_value_planner(f"{VALUE_PREFIX}{tmp_path / name}.json")


@pytest.mark.parametrize("name", ["fitted", "low", "high_slow", "tilted", "near_base"])
def test_the_answer_is_the_alternative_of_the_value_model(name, tmp_path, place):
    sentence = draw_sentence(place, "teach", np.random.default_rng(0))
    contracts = place.contracts()
    request = build_request(make_sample(place, contracts["fitted"], sentence))
    proposal = planner_that_prefers(name, tmp_path, place).propose(request)
    answer, expected = (msgspec.json.decode(text) for text in (proposal.text, contracts.get(name, contracts["fitted"])))
    assert answer == expected
    for one, other in zip(answer["action_sequence"], expected["action_sequence"], strict=True):
        assert list(one["params"]) == list(other["params"]), "parameters in the order of the schema"


def test_an_unreadable_file_is_refused_and_a_new_one_has_another_digest(tmp_path, place):
    path = tmp_path / "bad.json"
    path.write_text("[]")
    with pytest.raises(ConfigurationError, match="cannot be read"):
        load_value_planner(f"{VALUE_PREFIX}{path}")
    first = value_model_digest(f"{VALUE_PREFIX}{path}")
    path.write_bytes(msgspec.json.encode({"weights": {}}))
    assert first != value_model_digest(f"{VALUE_PREFIX}{path}")
    assert value_model_digest(f"{VALUE_PREFIX}{tmp_path / 'absent.json'}") == ""
