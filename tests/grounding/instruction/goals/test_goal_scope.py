"""The decoding schema admits the names, skills and number of actions that the goal of an instruction may need."""

import jsonschema_rs
import msgspec
import numpy as np
import pytest

from dualbrain.contracts.schema import DECLINE, decoding_schema, first_skills, step_schemas
from dualbrain.evaluation.planners.random_contract import sample_params
from dualbrain.grounding.envelope.scene_rules import skill_order
from dualbrain.grounding.instruction.goals.goal_reading import read_goal
from dualbrain.grounding.instruction.goals.goal_scope import goal_scope
from dualbrain.grounding.vocabulary import load_skill_registry, scene_names
from dualbrain.records import Scene
from tests.grounding.outcome.tabletop_cases import BEFORE

ALL = scene_names(BEFORE)
WAIT_AND_PUT = {"hold", "stop", "grasp", "place"}
DRAFT_2020 = "https://json-schema.org/draft/2020-12/schema"
"""The draft in which `prefixItems` is a keyword, as in the decoders."""
RNG = np.random.default_rng(0)
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
        ("wait for 3 seconds, then put the red cube in the bowl", ["red_cube"], ["blue_bowl"], WAIT_AND_PUT, (2, 3)),
    ],
)
def test_the_scope_is_that_of_the_words(instruction, graspable, receptive, skills, length):
    scope = scope_of(instruction)
    assert sorted(scope.names.graspable) == graspable
    assert list(scope.names.receptive) == receptive
    assert scope.skills == skills | {"decline"}
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


def answer(*skills):
    """A contract of these skills, with all parameters of the scope of two blocks."""
    steps = {step["properties"]["skill"]["const"]: step for step in step_schemas(two_blocks())}
    actions = [{"skill": skill, "params": sample_params(parameters(steps[skill]), RNG)} for skill in skills]
    context = {"robot": REGISTRY.robot, "registry": REGISTRY.hash}
    return {"id": "c-0001", "context": context, "action_sequence": actions}


def parameters(step):
    return step["properties"]["params"]["properties"]


def two_blocks():
    scope = scope_of("put all blocks in the bowl")
    order = skill_order([skill.name for skill in REGISTRY.skills], None)
    return decoding_schema(REGISTRY, scope.names, order=order, skills=scope.skills, length=scope.length)


@pytest.mark.parametrize(
    ("skills", "admitted"),
    [
        (["grasp", "place", "grasp", "place"], True),
        (["decline"], True),
        (["grasp"], False),
        (["grasp", "place"], False),
        (["grasp", "place", "grasp", "decline"], False),
        (["place", "grasp", "place", "grasp"], False),
        (["decline", "decline"], False),
        (["grasp", "place"] * 3, False),
    ],
)
def test_the_schema_admits_contracts_of_the_length_of_the_goal_and_a_decline_alone(skills, admitted):
    validator = jsonschema_rs.validator_for(two_blocks() | {"$schema": DRAFT_2020})
    assert validator.is_valid(answer(*skills)) == admitted


def test_the_schema_has_the_names_of_the_goal():
    grasp, place, decline = step_schemas(two_blocks())
    assert parameters(grasp)["object"]["enum"] == ["red_block", "yellow_block"]
    assert parameters(place)["destination"]["enum"] == ["blue_bowl"]
    assert set(first_skills(two_blocks())) == {"grasp", "decline"}
    assert decline["properties"]["skill"]["const"] == DECLINE


def test_without_a_scope_the_schema_is_unchanged():
    assert decoding_schema(REGISTRY, ALL) == decoding_schema(REGISTRY, ALL, skills=None, length=None)
    assert "anyOf" not in decoding_schema(REGISTRY, ALL)["properties"]["action_sequence"]
