"""Several goals in one contract, from the instruction to ground truth: the prompt, and the judgement."""

import pytest

from dualbrain.planner.prompt.full_prompt import render
from tests.stories.story_session import GRASP, PLACE, contract_text, run_config, run_session

CASES = {
    "all of a colour": (
        "sorting:2",
        "put all the red things in the bowl",
        "put all red things in the blue bowl",
        (("red_cube", "blue_bowl"), ("red_block", "blue_bowl")),
    ),
    "an occupied bowl": (
        "sorting:1",
        "if the bowl is free put the red cube in it, otherwise on the left side of the table",
        "if blue_bowl is free put red_cube in blue_bowl else put red_cube on table_left",
        (("red_cube", "table_left"),),
    ),
}


def sorting_contract(placements):
    """The contract that puts each object at its destination."""
    steps = []
    for name, destination in placements:
        steps.append(("grasp", {**GRASP, "object": name, "opening": 0.08, "clearance": 0.15}))
        steps.append(("place", {**PLACE, "destination": destination, "clearance": 0.15}))
    return contract_text(*steps)


@pytest.mark.parametrize("case", [pytest.param("all of a colour", marks=pytest.mark.slow), "an occupied bowl"])
def test_the_prompt_has_the_rules_of_several_goals_and_ground_truth_is_judged_by_them(case, tmp_path):
    scene, instruction, goal, placements = CASES[case]
    config = run_config(tmp_path, scene=scene, instruction=instruction, goal=goal)
    story = run_session(config, sorting_contract(placements))
    (request,) = story.planner.requests
    assert "This instruction needs care" in render(request)[-1]["content"]
    assert ("blue_bowl: container, holds green_tin" in request.scene) == (case == "an occupied bowl")
    assert story.episode.outcome.kind == "succeeded", story.episode.outcome.reason
    judgement = story.episode.judgement
    assert judgement is not None
    assert judgement.success
    assert judgement.violations == ()
    assert story.episode.second_opinion == "agrees"
