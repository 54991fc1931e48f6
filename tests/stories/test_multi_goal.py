"""Several goals in one contract, from words to truth: what the planner is told, and what counts as done."""

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
    "a taken bowl": (
        "sorting:1",
        "if the bowl is free put the red cube in it, otherwise on the left side of the table",
        "if blue_bowl is free put red_cube in blue_bowl else put red_cube on table_left",
        (("red_cube", "table_left"),),
    ),
}


def fetching(things):
    """The contract that puts each thing where it belongs."""
    steps = []
    for name, destination in things:
        steps.append(("grasp", {**GRASP, "object": name, "opening": 0.08, "clearance": 0.15}))
        steps.append(("place", {**PLACE, "destination": destination, "clearance": 0.15}))
    return contract_text(*steps)


@pytest.mark.parametrize("case", [pytest.param("all of a colour", marks=pytest.mark.slow), "a taken bowl"])
def test_the_planner_is_told_and_the_truth_is_judged_by_what_was_asked(case, tmp_path):
    scene, words, goal, things = CASES[case]
    story = run_session(run_config(tmp_path, scene=scene, instruction=words, goal=goal), fetching(things))
    (asked,) = story.planner.requests
    assert "This instruction needs care" in render(asked)[-1]["content"]
    assert ("blue_bowl: container, holds green_tin" in asked.scene) == (case == "a taken bowl")
    assert story.episode.outcome.kind == "succeeded", story.episode.outcome.reason
    judgement = story.episode.judgement
    assert judgement is not None
    assert judgement.success
    assert judgement.violations == ()
    assert story.episode.second_opinion == "agrees"
