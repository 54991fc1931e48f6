"""Remarks beside a request: left out if they ask for nothing, kept if they may limit the request."""

import pytest

from dualbrain.grounding.instruction.goals.goal import Goal, Held, Observed, Placed, Pushed, RobotEnds, Unread
from dualbrain.grounding.instruction.goals.goal_reading import read_goal
from dualbrain.grounding.instruction.goals.remarks import without_remarks
from tests.grounding.outcome.tabletop_cases import BEFORE

NAMES = (*BEFORE.graspable, *BEFORE.receptive)
IN_BOWL = Placed(("red_cube",), "in", ("blue_bowl",))
LEFT = Placed(("red_cube",), "at", ("table_left",))


@pytest.mark.parametrize(
    ("words", "conditions"),
    [
        ("My hands are full, so could you put the red cube in the bowl? It's for my neighbour.", (IN_BOWL,)),
        ("Good morning, my friend! The red cube in the bowl, please and thank you.", (IN_BOWL,)),
        ("It's raining again, what a surprise. Take the red cube to the left for us.", (LEFT,)),
        ("I've asked Henry twice already and he won't listen, so you put the red cube on the left.", (LEFT,)),
        ("red cube, left side, thanks", (LEFT,)),
        ("pls put teh red cube to the lef, im tired", (LEFT,)),
        ("the red cube left and the green tin right", (LEFT, Placed(("green_tin",), "at", ("table_right",)))),
        ("The glass is from my professor, so grip it with 6 newtons", (Held(("clear_glass",)),)),
        ("Red cube: push it towards the bowl, easy does it", (Pushed(("red_cube",), "toward", "blue_bowl"),)),
        ("I'd love to see the red cube put in the bowl", (IN_BOWL,)),
        ("Could the red cube go in the bowl, if it's no bother?", (IN_BOWL,)),
        ("have a look at the tin that isn't red, would you", (Observed("green_tin"),)),
        ("We're finished for today, my dear, you may go back home.", (RobotEnds("home"),)),
        ("the red cube, not the red block, in the bowl", (IN_BOWL,)),
    ],
)
def test_a_goal_is_read_beside_remarks(words, conditions):
    goal = read_goal(words, BEFORE)
    assert isinstance(goal, Goal), goal
    assert goal.conditions == conditions


@pytest.mark.parametrize(
    "remark",
    [
        "it should be upside down",
        "I want it quickly out of there",
        "that must not happen before lunch",
        "we move the tin afterwards",
        "the tin stays here",
        "she decides first",
        "we lift that up now",
        "if it rings I will wave",
        "the green one is wrong",
        "all but the tin",
        "wiggle your fingers",
    ],
)
def test_a_part_that_may_limit_the_request_is_kept_and_the_goal_is_not_read(remark):
    words = f"Put the red cube in the bowl, {remark}."
    assert remark.split()[-1].lower() in without_remarks(words, NAMES)
    assert isinstance(read_goal(words, BEFORE), Unread)


def test_a_contrast_within_a_group_is_no_remark():
    assert "not the red" in without_remarks("all blocks, not the red one, in the bowl", NAMES)


@pytest.mark.parametrize("part", ["sorry ", "thank you for you ", "how nice are you ", "cube left and ", "is it not "])
def test_repeated_phrases_do_not_multiply_the_search(part):
    """Each phrase may end in several ways; only atomic groups keep the search linear."""
    assert isinstance(read_goal(f"{part * 100}"[:390] + "9", BEFORE), Goal | Unread)
