"""The value model: utility, symbols, recovery of a known rule, uncertainty, and the choice."""

import msgspec
import numpy as np
import pytest

from dualbrain.adaptation.value_model.symbols import SYMBOLS, Placement, symbol_vector
from dualbrain.adaptation.value_model.utility import utility
from dualbrain.adaptation.value_model.value_model import (
    CHOICE_MARGIN,
    ExecutedSiblings,
    best_fixed_alternative,
    fit_value_model,
    load_value_model,
    save_value_model,
)
from dualbrain.errors import ConfigurationError

SUMMARY = """robot panda; holding nothing
red_cube: object, free_finger_axis across, opening 0.055, tight, neighbour_along low <3cm, neighbour_across tall >6cm, \
fragile, path_max_height tall, overhead over_path, over_end, clearance 0.08, path_max_height none, clearance 0.1
near_edge: object, free_finger_axis along, path_max_height low, path_max_height low
blue_bowl: container
green_bowl: container, holds red_block
person: crossing
places: table_left"""


def symbols(summary=SUMMARY, obj="red_cube", destination="blue_bowl"):
    vector = symbol_vector(Placement(summary, obj, destination))
    return {name for name, value in zip(SYMBOLS, vector, strict=True) if value}


def test_symbols_are_relative_to_the_free_axis_and_to_the_destination():
    assert symbols() == {
        "constant",
        "tight",
        "tall neighbour on the free axis",
        "low neighbour on the other axis",
        "neighbour within 3 cm on the other axis",
        "tall object on the path",
        "overhead",
        "overhead above the end",
        "fragile",
        "person crossing",
    }
    assert "tall object on the path" not in symbols(destination="green_bowl")
    assert "to a place" in symbols(destination="table_left")


def test_a_name_is_not_a_symbol():
    assert "near the edge" not in symbols(obj="near_edge")
    assert symbols(obj="absent") == {"constant", "person crossing"}


def test_utility_prefers_success_then_little_intervention_then_little_time():
    clean = utility(succeeded=True, Delta=0.0, duration=10.0)
    assert clean == utility(succeeded=True, Delta=None, duration=12.0) == 1.0
    assert (
        clean > utility(succeeded=True, Delta=0.0, duration=20.0) > utility(succeeded=True, Delta=0.005, duration=10.0)
    )
    assert utility(succeeded=True, Delta=1.0, duration=60.0) > 0.0 == utility(succeeded=False, Delta=0.0, duration=5.0)


def siblings(n, rng, noise=0.0):
    """Places with a rule: `low` is better below an obstacle, `high` elsewhere; the difficulty differs by place."""
    found = []
    for index in range(n):
        overhead = bool(rng.integers(2))
        words = "object, free_finger_axis along" + (", overhead over_path" if overhead else "")
        summary = f"red_cube: {words}\nblue_bowl: container"
        place = float(rng.uniform(0.0, 0.5))
        utilities = {
            "fitted": place + 0.25,
            "low": place + (0.5 if overhead else 0.0),
            "high": place + (0.0 if overhead else 0.5),
        }
        noisy = {name: value + noise * float(rng.normal()) for name, value in utilities.items()}
        found.append(ExecutedSiblings(Placement(summary + f"\nperson: p{index}", "red_cube", "blue_bowl"), noisy))
    return found


def test_the_model_recovers_a_rule_that_no_fixed_alternative_follows():
    rng = np.random.default_rng(0)
    model = fit_value_model(siblings(60, rng, noise=0.1))
    held_out = siblings(40, rng)
    chosen = [model.choose(one.placement, list(one.utilities), "fitted") for one in held_out]
    for one, name in zip(held_out, chosen, strict=True):
        assert name == ("low" if "overhead" in one.placement.summary else "high")
    fixed = best_fixed_alternative(held_out)
    gain = np.mean([one.utilities[name] - one.utilities[fixed] for one, name in zip(held_out, chosen, strict=True)])
    assert gain > 0.1


def test_the_difficulty_of_a_place_cancels():
    places = siblings(30, np.random.default_rng(1))
    shifted = [
        ExecutedSiblings(one.placement, {name: value + index for name, value in one.utilities.items()})
        for index, one in enumerate(places)
    ]
    for one, other in zip(
        fit_value_model(places).weights.values(), fit_value_model(shifted).weights.values(), strict=True
    ):
        assert np.allclose(one, other)


def test_uncertainty_falls_with_executions_and_grows_where_nothing_was_executed():
    rng = np.random.default_rng(2)
    few, many = (fit_value_model(siblings(n, rng, noise=0.1)) for n in (10, 200))
    seen, unseen = siblings(1, rng)[0].placement, Placement(SUMMARY, "red_cube", "blue_bowl")
    assert few.rank(seen)[0].deviation > many.rank(seen)[0].deviation
    assert many.rank(unseen)[0].deviation > many.rank(seen)[0].deviation


def test_the_default_is_chosen_unless_another_is_clearly_better():
    rng = np.random.default_rng(3)
    places = [
        ExecutedSiblings(one.placement, {"fitted": 0.9, "low": 0.9 + 0.5 * CHOICE_MARGIN}) for one in siblings(20, rng)
    ]
    model = fit_value_model(places)
    assert model.rank(places[0].placement)[0].name == "low"
    assert model.choose(places[0].placement, ["fitted", "low"], "fitted") == "fitted"
    assert model.choose(places[0].placement, ["unknown"], "fitted") == "fitted"


def test_a_saved_model_predicts_the_same(tmp_path):
    model = fit_value_model(siblings(20, np.random.default_rng(4), noise=0.1))
    save_value_model(model, tmp_path / "value.json")
    assert load_value_model(tmp_path / "value.json") == model


def test_unusable_data_and_files_are_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="two alternatives"):
        fit_value_model([ExecutedSiblings(Placement(SUMMARY, "red_cube", "blue_bowl"), {"fitted": 1.0})])
    path = tmp_path / "value.json"
    path.write_text("{}")
    with pytest.raises(ConfigurationError, match="cannot be read"):
        load_value_model(path)
    model = fit_value_model(siblings(20, np.random.default_rng(4)))
    save_value_model(model, path)
    path.write_text(path.read_text().replace("tight", "loose"))
    with pytest.raises(ConfigurationError, match="other symbols"):
        load_value_model(path)


@pytest.mark.parametrize("damage", ["short weights", "no covariance", "short row", "no rows", "variance"])
def test_an_inconsistent_model_is_refused_when_it_is_read(tmp_path, damage):
    model = fit_value_model(siblings(20, np.random.default_rng(4)))
    name = next(iter(model.weights))
    matrix = model.covariances[name]
    changes = {
        "short weights": {"weights": {**model.weights, name: model.weights[name][:-1]}},
        "no covariance": {"covariances": {other: one for other, one in model.covariances.items() if other != name}},
        "short row": {"covariances": {**model.covariances, name: [matrix[0][:-1], *matrix[1:]]}},
        "no rows": {"covariances": {**model.covariances, name: matrix[:-1]}},
        "variance": {"variance": -1.0},
    }
    save_value_model(msgspec.structs.replace(model, **changes[damage]), tmp_path / "value.json")
    with pytest.raises(ConfigurationError, match="lacks a number"):
        load_value_model(tmp_path / "value.json")
