"""Wordings of people who do not know the parser, each beside a similar one that asks for something else."""

import pytest

from dualbrain.grounding.instruction.goals.goal import Goal, Placed, Pushed, RobotEnds, Unmoved
from dualbrain.grounding.instruction.goals.goal_reading import read_goal
from dualbrain.grounding.instruction.review import Refusal, review_instruction
from dualbrain.robots.loader import load_robot
from dualbrain.skills.registry import skill_registry
from tests.grounding.outcome.tabletop_cases import BEFORE

IN_BOWL = Placed(("green_tin",), "in", ("blue_bowl",))
LEFT = Placed(("green_tin",), "at", ("table_left",))
REGISTRY = skill_registry(load_robot("panda"))


def review(words):
    return review_instruction(words, REGISTRY, BEFORE.receptive, BEFORE.graspable)


@pytest.mark.parametrize(
    ("words", "conditions"),
    [
        ("The green tin ought to be sitting in the blue bowl, not out here on the table.", (IN_BOWL,)),
        ("The green tin would be better off on the left side of the table, don't you think?", (LEFT,)),
        ("The green tin is supposed to be in the bowl, can you see to it?", (IN_BOWL,)),
        ("Would it be possible for the green tin to be inside the bowl instead of lying around there?", (IN_BOWL,)),
        ("The green tin should stand on the left side of the table today, not in the middle.", (LEFT,)),
        ("Let's have the green tin in the bowl.", (IN_BOWL,)),
        ("Make sure the green tin is in the bowl, please.", (IN_BOWL,)),
        ("the green tin needs clearing away into the bowl", (IN_BOWL,)),
        ("My kid left the green tin lying about again. It lives in the bowl.", (IN_BOWL,)),
        ("He's finished with the green tin, so put it on the left side of the table, out of the way.", (LEFT,)),
        ("There's a green tin hiding somewhere behind those tall bottles. I want it in the bowl.", (IN_BOWL,)),
        ("I'll try and keep my arm out of your way. The green tin into the bowl, please.", (IN_BOWL,)),
        ("the green tin is in my way, could it live in the bowl instead?", (IN_BOWL,)),
        ("Green tin. Left side of the table. Go.", (LEFT,)),
        ("bowl. green tin. now.", (IN_BOWL,)),
        ("Green tin: left side of the table.", (LEFT,)),
        ("cuold you drop the gren tin in the bwol", (IN_BOWL,)),
        ("put the green tin in the bowl and everything else stays where it is", (IN_BOWL,)),
        ("put the green tin in the bowl, and please don't knock the glass", (IN_BOWL, Unmoved(("clear_glass",)))),
        ("Take the green tin and leave it in the bowl. Watch out for the bottles.", (IN_BOWL,)),
        (
            "edge the green tin a tiny bit towards the bowl, no lifting",
            (Pushed(("green_tin",), "toward", "blue_bowl"),),
        ),
        ("Fold yourself back into the pose you started from.", (RobotEnds("home"),)),
        ("Please retract to your home position.", (RobotEnds("home"),)),
    ],
)
def test_the_request_is_read_and_no_clause_is_found(words, conditions):
    assert review(words) is None
    goal = read_goal(words, BEFORE)
    assert isinstance(goal, Goal), goal
    assert goal.conditions == conditions


@pytest.mark.parametrize(
    "words",
    [
        "Let us have the green tin.",
        "put the green tin in the bowl instead of the red cube",
        "put all blocks in the bowl, not the red ones",
        "The green tin should be in the bowl, not the lid.",
        "pick up the green tin, no gripping by the rim",
        "put the green tin among those bottles",
        "There's a green tin. Put it among the blocks.",
        "the green tin stays in the bowl until it is dry, then it goes to the left side of the table",
    ],
)
def test_a_similar_clause_is_still_found(words):
    assert isinstance(review(words), Refusal)


@pytest.mark.parametrize(
    "words",
    [
        "There's a green tin. I want it upside down in the bowl.",
        "I am going to want the green tin in the bowl later",
        "I will ask you to put the green tin in the bowl",
        "My kid wants the green tin. It should lie on its side in the bowl.",
        "the green tin. the red cube. the bowl.",
        "green tin: bowl: left side of the table",
        "the green tin is in the bowl",
        "the green tin moves",
        "don't knock the green tin into the bowl",
    ],
)
def test_no_placement_of_the_tin_is_read_from_other_words(words):
    goal = read_goal(words, BEFORE)
    placed = [one for one in goal.conditions if isinstance(one, Placed)] if isinstance(goal, Goal) else []
    assert review(words) is not None or not placed
