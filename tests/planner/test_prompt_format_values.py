"""The short prompt of adapters that were trained with fitting parameter values in the scene."""

from dualbrain.planner.prompt.prompt_format import SHORT_PROMPT, short_prompt
from tests.planner.sample_requests import plan_request

WITH_VALUES = "red_cube: object, free_finger_axis along, opening 0.055, path_max_height none, clearance 0.08"


def test_only_adapters_trained_with_values_see_them():
    request = plan_request(scene_with_values=WITH_VALUES)
    assert "opening 0.055" in short_prompt(scene_values=True).messages(request)[-1]["content"]
    assert "opening 0.055" not in short_prompt(scene_values=False).messages(request)[-1]["content"]


def test_a_request_without_values_has_the_plain_scene():
    request = plan_request()
    assert short_prompt(scene_values=True).messages(request) == SHORT_PROMPT.messages(request)
