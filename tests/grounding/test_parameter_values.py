"""Values of parameters from the geometry of a scene, and the alternatives that use them."""

import numpy as np
import pytest

from dualbrain.contracts.canonical_form import canonical_contract
from dualbrain.contracts.contract import Context, Contract
from dualbrain.contracts.skill_spec import NumberParameter
from dualbrain.grounding.alternatives import CHANGED_LEVELS, COMMON_LEVELS, DEFAULT_ALTERNATIVE, alternatives
from dualbrain.grounding.envelope.grasp_fit import FINGER_MARGIN
from dualbrain.grounding.parameter_values import (
    MAX_FITTED_CLEARANCE,
    OPENING_MARGIN,
    PATH_MARGIN,
    fitted_opening,
    path_clearance,
)
from dualbrain.grounding.scene_paths import PathEnd, is_below_overhead_object, overhead_objects_on_path
from dualbrain.grounding.scene_summary import free_finger_axis, summarise_scene
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.records import Scene
from dualbrain.skills.kinematics.object_geometry import grasp_width
from dualbrain.skills.parameters import LEVELS
from tests.grounding.perceived_scenes import TABLE, bowl, box

PLACEMENT = (("grasp", {"object": "red_cube"}), ("place", {"destination": "blue_bowl"}))
BOWL_END = PathEnd("blue_bowl", np.array([0.5, 0.26, 0.0]))


def scene_with(*objects):
    return Scene(robot="panda", stamp=0.0, objects=(TABLE, bowl(), *objects), places=(), version=1)


def board(height, y=0.13):
    return box("board", 0.5, y, (0.1, 0.05, 0.01), role="obstacle", z=height)


@pytest.mark.parametrize("yaw", [0.0, 0.3, 0.8])
def test_a_fitted_opening_leaves_more_than_the_gate_requires(yaw):
    obj = box("red_cube", 0.5, 0.0, (0.02, 0.025, 0.03), yaw=yaw)
    for axis in ("along", "across"):
        opening = fitted_opening(obj, axis)
        assert grasp_width(obj, axis) + OPENING_MARGIN <= opening + 1e-9
        assert opening - grasp_width(obj, axis) - OPENING_MARGIN < 1e-3
    assert OPENING_MARGIN > FINGER_MARGIN


def test_a_wide_object_has_the_widest_opening():
    assert fitted_opening(box("big", 0.5, 0.0, (0.04, 0.04, 0.04)), "along") == LEVELS["opening"]["wide"]


@pytest.mark.parametrize("half", [0.02, 0.05, 0.09, 0.12])
def test_a_fitted_clearance_passes_over_the_highest_object_on_the_path(half):
    cube, post = box("red_cube", 0.5, 0.0), box("post", 0.5, 0.13, (0.02, 0.02, half))
    expected = np.ceil(100 * (2 * half + PATH_MARGIN) - 1e-6) / 100
    assert path_clearance(scene_with(cube, post), cube, BOWL_END) == pytest.approx(max(expected, 0.08))


def test_objects_beside_the_path_do_not_count():
    cube, post = box("red_cube", 0.5, 0.0), box("post", 0.8, 0.13, (0.02, 0.02, 0.15))
    assert path_clearance(scene_with(cube, post), cube, BOWL_END) == LEVELS["clearance"]["low"]


def test_a_low_board_is_passed_above_and_a_high_one_below():
    cube = box("red_cube", 0.5, 0.0)
    low, high = scene_with(cube, board(0.265)), scene_with(cube, board(0.45))
    assert path_clearance(low, cube, BOWL_END) == pytest.approx(0.32)
    assert path_clearance(high, cube, BOWL_END) == LEVELS["clearance"]["low"]
    assert path_clearance(low, cube, BOWL_END) <= MAX_FITTED_CLEARANCE


def test_the_summary_names_the_part_of_the_path_that_a_board_covers():
    cube = box("red_cube", 0.5, 0.0)
    over_object, over_end = scene_with(cube, board(0.45, y=0.0)), scene_with(cube, board(0.45, y=0.3))
    assert overhead_objects_on_path(over_object, cube, BOWL_END)
    assert is_below_overhead_object(over_object, np.array([0.5, 0.0]))
    assert "overhead over_path, over_object, clearance" in summarise_scene(over_object, values=True)
    assert "overhead over_path, over_end, clearance" in summarise_scene(over_end, values=True)


def test_a_summary_without_values_is_unchanged():
    scene = scene_with(box("red_cube", 0.5, 0.0), board(0.45))
    with_values, plain = summarise_scene(scene, values=True), summarise_scene(scene)
    assert "red_cube: object, free_finger_axis along, opening 0.055, " in with_values
    for word in ("opening", "clearance", "over_object", "over_end"):
        assert word not in plain


def test_alternatives_differ_from_the_default_in_their_declared_levels_only():
    registry = load_skill_registry("panda")
    scene = scene_with(box("red_cube", 0.5, 0.0), box("post", 0.5, 0.13, (0.02, 0.02, 0.1)))
    found = alternatives(registry, scene, PLACEMENT)
    default = found[DEFAULT_ALTERNATIVE]
    assert set(found) == set(CHANGED_LEVELS) - {"slow_turns"}, "an arm does not turn"
    for name, actions in found.items():
        assert [one.skill for one in actions] == ["grasp", "place"]
        differing = {
            parameter
            for one, other in zip(actions, default, strict=True)
            for parameter, value in one.params.items()
            if other.params[parameter] != value
        }
        allowed = set(CHANGED_LEVELS[name]) | ({"opening"} if name == "other_axis" else set())
        assert differing <= allowed, name
        assert bool(differing) == (name != DEFAULT_ALTERNATIVE)


def test_the_default_copies_the_words_of_the_summary():
    registry = load_skill_registry("panda")
    cube = box("red_cube", 0.5, 0.0, (0.02, 0.015, 0.02))
    scene = scene_with(cube, box("wall", 0.56, 0.0, (0.01, 0.05, 0.1)), box("post", 0.5, 0.13, (0.02, 0.02, 0.1)))
    grasp, place = alternatives(registry, scene, PLACEMENT)[DEFAULT_ALTERNATIVE]
    line = next(one for one in summarise_scene(scene, values=True).splitlines() if one.startswith("red_cube"))
    assert grasp.params["finger_axis"] == free_finger_axis(scene, cube) == "across"
    assert f"free_finger_axis {grasp.params['finger_axis']}, opening {grasp.params['opening']:g}" in line
    assert line.endswith(f"clearance {grasp.params['clearance']:g}")
    assert place.params["clearance"] == grasp.params["clearance"]


@pytest.mark.parametrize("robot", ["panda", "ur5e"])
def test_values_are_within_the_bounds_of_each_robot(robot):
    registry, scene = load_skill_registry(robot), scene_with(box("red_cube", 0.5, 0.0))
    for actions in alternatives(registry, scene, PLACEMENT).values():
        for action in actions:
            for parameter in registry.skill(action.skill).parameters:
                if isinstance(parameter, NumberParameter):
                    assert parameter.lower <= action.params[parameter.name] <= parameter.upper


def test_every_level_is_declared():
    scene_levels = {"fitted", "free", "other"}
    for levels in (COMMON_LEVELS, *CHANGED_LEVELS.values()):
        assert all(level in scene_levels or level in LEVELS[name] for name, level in levels.items())


def test_alternatives_of_a_mobile_base_change_speeds():
    registry = load_skill_registry("base")
    scene = Scene(robot="base", stamp=0.0, objects=(), places=(), version=1)
    found = alternatives(registry, scene, (("drive_to", {"place": "shelf"}),))
    assert set(found) == {"fitted", "slow", "fast", "slow_turns"}
    contract = Contract("c-0001", Context("base", registry.hash), found["slow"])
    assert '"max_speed":0.2' in canonical_contract(contract, registry)
