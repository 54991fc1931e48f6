"""The decoding schema admits the names, skills and number of actions that the goal of an instruction may need."""

import msgspec
import pytest

from dualbrain.contracts.schema import DECLINE, decoding_schema, first_skills, step_schemas
from dualbrain.grounding.instruction.goals.goal_reading import read_goal
from dualbrain.grounding.instruction.goals.goal_scope import goal_scope
from dualbrain.grounding.vocabulary import load_skill_registry, scene_names
from dualbrain.records import Scene
from tests.grounding.outcome.tabletop_cases import BEFORE

ALL = scene_names(BEFORE)
REGISTRY = load_skill_registry("panda")


def scope_of(instruction, holding=None, scene: Scene = BEFORE):
    return goal_scope(read_goal(instruction, scene), scene, holding)


@pytest.mark.parametrize(
    ("instruction", "graspable", "receptive", "skills", "length"),
    [
        ("put the red cube in the bowl", ["red_cube"], ["blue_bowl"], {"grasp", "place"}, (2, 2)),
        ("put all blocks in the bowl", ["red_block", "yellow_block"], ["blue_bowl"], {"grasp", "place"}, (4, 4)),
        ("put a block in the bowl", ["red_block", "yellow_block"], ["blue_bowl"], {"grasp", "place"}, (2, 2)),
        ("put the red cube in the bowl, then go home", ["red_cube"], ["blue_bowl"], {"grasp", "place", "home"}, (3, 3)),
        ("pick up the red cube", ["red_cube"], [], {"grasp"}, (1, 1)),
        ("push the red cube toward the bowl", ["red_cube"], ["blue_bowl"], {"push"}, (1, 1)),
        ("look at the tin", ["green_tin"], [], {"move_to"}, (1, 1)),
        ("go home", [], [], {"home"}, (1, 1)),
    ],
)
def test_the_scope_is_that_of_the_words(instruction, graspable, receptive, skills, length):
    scope = scope_of(instruction)
    assert sorted(scope.names.graspable) == graspable
    assert list(scope.names.receptive) == receptive
    assert scope.skills == skills | {"decline", "hold", "stop"}
    assert scope.length == length


@pytest.mark.parametrize(
    "instruction",
    [
        "arrange the red cube nicely",
        "put the banana in the bowl",
        "hand me the red cube",
        "put the cube left of the bowl",
    ],
)
def test_an_instruction_that_is_not_read_or_to_be_declined_restricts_nothing(instruction):
    scope = scope_of(instruction)
    assert (scope.names, scope.skills, scope.length) == (ALL, None, None)


def test_the_hand_may_first_put_down_what_it_holds():
    scope = scope_of("put the red cube in the bowl", holding="green_tin")
    assert {"place", "release"} <= scope.skills
    assert scope.names.receptive == ALL.receptive
    assert scope.length == (2, 3)
    assert scope_of("put the red cube in the bowl", holding="red_cube").length == (1, 3)


def test_an_object_that_is_there_already_need_not_be_moved_again():
    inside = tuple(
        msgspec.structs.replace(obj, pose=msgspec.structs.replace(obj.pose, position=(0.50, 0.25, 0.03)))
        if obj.name == "red_cube"
        else obj
        for obj in BEFORE.objects
    )
    scene = msgspec.structs.replace(BEFORE, objects=inside)
    assert scope_of("put the red cube and the tin in the bowl", scene=scene).length == (2, 4)


def test_a_base_may_drive_anywhere_between_its_actions():
    scene = msgspec.structs.replace(BEFORE, region=((0.0, 0.0), (4.0, 0.0), (4.0, 4.0)))
    scope = scope_of("put the red cube in the bowl", scene=scene)
    assert {"drive_to", "grasp", "place"} <= scope.skills
    assert scope.length is None
    assert scope.names.receptive == ALL.receptive


def test_the_schema_admits_the_scope_and_always_a_decline():
    scope = scope_of("put all blocks in the bowl")
    schema = decoding_schema(REGISTRY, scope.names, skills=scope.skills, length=scope.length)
    several, alone = schema["properties"]["action_sequence"]["anyOf"]
    assert (several["minItems"], several["maxItems"]) == (4, 4)
    assert (alone["minItems"], alone["maxItems"]) == (1, 1)
    assert alone["items"]["properties"]["skill"]["const"] == DECLINE
    assert set(first_skills(schema)) == {"grasp", "place", "hold", "decline"}
    (grasp,) = (step for step in step_schemas(schema) if step["properties"]["skill"]["const"] == "grasp")
    assert grasp["properties"]["params"]["properties"]["object"]["enum"] == ["red_block", "yellow_block"]


def test_without_a_scope_the_schema_is_unchanged():
    assert decoding_schema(REGISTRY, ALL) == decoding_schema(REGISTRY, ALL, skills=None, length=None)
    assert "anyOf" not in decoding_schema(REGISTRY, ALL)["properties"]["action_sequence"]
