"""Instructions that the local layer declines before a planner, and those that it leaves to the planner."""

from types import SimpleNamespace

import pytest

from dualbrain.grounding.envelope.robot_at_site import open_robot_at_site
from dualbrain.grounding.instruction.review import Refusal
from dualbrain.grounding.offline_gate import scene_from_spec
from dualbrain.planner.scripted import FixedContractPlanner
from dualbrain.runtime.inspection.dry_run import context_at_home
from dualbrain.runtime.planning import local_answer
from dualbrain.runtime.planning.local_answer import answer_locally
from dualbrain.simulation.scenes.generators.catalogue import open_scene

PLANNER = SimpleNamespace(languages=("en", "fr"))
FRENCH = SimpleNamespace(code="fr", name="French")


@pytest.fixture(scope="module")
def context():
    """A red cube, a teal can, a yellow can and a blue bowl in front of a Panda."""
    return context_at_home(open_robot_at_site("panda"), scene_from_spec(open_scene("edge:40402", "panda")))


@pytest.mark.parametrize(
    ("instruction", "phrase"),
    [
        ("put the green tin in the bowl", "green tin"),
        ("the purple bottle has to go to the right side of the table", "purple bottle"),
        ("put the red cube and the green tin in the bowl", "green tin"),
        ("put the red cube in the green bowl", "green bowl"),
    ],
)
def test_an_object_that_is_not_there_is_declined_with_the_names_that_are(context, instruction, phrase):
    answer = answer_locally(instruction, context, PLANNER)
    assert isinstance(answer, Refusal)
    assert answer.kind == "absent"
    assert f'there is no "{phrase}" in the scene. Objects and places here: red cube, ' in answer.reason


def test_steps_that_need_a_full_hand_are_declined_before_a_planner(context):
    answer = answer_locally("lift the teal can, then put the red cube in the bowl", context, PLANNER)
    assert isinstance(answer, Refusal)
    assert answer.kind == "hand"
    assert "the hand still holds teal can when it is to move red cube" in answer.reason


@pytest.mark.parametrize(
    "instruction",
    [
        "put the red cube in the bowl",
        "put the red cube in the bowl, then lift the teal can",
        "put the turquoise tin in the bowl",
        "pick up the soda",
        "put the drink on the left side of the table",
        "put the banana in the bowl",
        "open your hand",
        "Pour finir, mets le cube rouge dans le bol bleu",
        "put everything that is yellow in the bowl",
    ],
)
def test_what_may_be_meant_is_left_to_the_planner(context, instruction):
    assert answer_locally(instruction, context, PLANNER) is None


def test_the_goal_of_a_sentence_in_another_language_is_not_judged(context, monkeypatch):
    monkeypatch.setattr(local_answer, "detect_foreign_language", lambda text: FRENCH)
    assert answer_locally("put the green tin in the bowl", context, PLANNER) is None


def test_a_fixed_contract_is_not_replaced(context):
    fixed = FixedContractPlanner("a person", b"{}")
    assert answer_locally("put the green tin in the bowl", context, fixed) is None
