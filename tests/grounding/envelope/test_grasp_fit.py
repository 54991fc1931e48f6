"""The grasps that the decoder admits are those whose axis, opening and force the gate accepts."""

import json
import re
from functools import cache

import jsonschema_rs
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.contracts.parameter_domains import ParameterDomain
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.schema import decoding_schema, first_skills
from dualbrain.core.geometry.shapes import Box, Cylinder, Pose, Sphere
from dualbrain.grounding.envelope.grasp_fit import parameter_domains, why_ungraspable
from dualbrain.grounding.envelope.scene_rules import scene_rules, skill_order
from dualbrain.grounding.offline_gate import controller_at_home
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.planner.decoding.llguidance_grammar import actions_grammar
from dualbrain.records import Proposal, SceneObject
from dualbrain.robots.loader import load_robot
from dualbrain.runtime.planning.planner_request import PlanningContext, answer_schema
from dualbrain.runtime.planning.proposal_checks import reject_mismatch
from dualbrain.skills.registry import skill_registry
from tests.grounding.perceived_scenes import bowl, box, scene
from tests.stories.story_session import GRASP, PLACE, decline_contract

ROBOTS = {name: skill_registry(load_robot(name)) for name in ("panda", "ur5e", "fr3")}

BOOK = box("book", 0.4, 0.2, (0.0324, 0.05, 0.02))
LENGTHS = st.floats(0.004, 0.05)
SHAPES = st.one_of(
    st.builds(Box, st.tuples(LENGTHS, LENGTHS, LENGTHS)),
    st.builds(Cylinder, LENGTHS, LENGTHS),
    st.builds(Sphere, LENGTHS),
)
QUATERNIONS = st.tuples(*4 * [st.floats(-1.0, 1.0)]).filter(lambda q: np.linalg.norm(q) > 0.1)
LIMITS = st.none() | st.floats(1.0, 80.0)


@st.composite
def objects(draw, name):
    quaternion = np.array(draw(QUATERNIONS))
    pose = Pose((0.5, -0.2, 0.06), tuple((quaternion / np.linalg.norm(quaternion)).tolist()))
    return SceneObject(name=name, role="object", shape=draw(SHAPES), pose=pose, fragile_limit=draw(LIMITS))


def schema_of(perceived, registry):
    domains = parameter_domains(perceived, registry)
    return decoding_schema(registry, scene_names(perceived), domains=domains)


def contract_with(robot, params):
    return Contract("c-0001", Context(robot, ROBOTS[robot].hash), (Action("grasp", params),))


def is_admitted(schema, contract):
    return jsonschema_rs.validator_for(schema).is_valid(msgspec.to_builtins(contract))


def fits(perceived, robot, params):
    """Whether the gate finds no fault in axis, opening and least force; the reach is another question."""
    rules = scene_rules(perceived, controller_at_home(robot, perceived))
    rejections = [found for rule in rules if (found := rule(contract_with(robot, params)))]
    return not any(one.pointer.endswith(("finger_axis", "opening")) or "presses" in one.hint for one in rejections)


@settings(max_examples=150, deadline=None)
@given(
    objects("red_cube"),
    objects("tin"),
    st.sampled_from(sorted(ROBOTS)),
    st.sampled_from(["along", "across"]),
    st.floats(0.0, 1.0),
)
def test_no_grasp_that_fits_is_lost_and_no_other_is_admitted(target, other, robot, axis, fraction):
    perceived = msgspec.structs.replace(scene(target, other, bowl()), robot=robot)
    registry = ROBOTS[robot]
    opening, force = ({p.name: p for p in registry.skill("grasp").parameters}[name] for name in ("opening", "force"))
    width = opening.lower + fraction * (opening.upper - opening.lower)
    params = GRASP | {"object": "red_cube", "finger_axis": axis, "opening": width, "force": force.lower}
    admitted = is_admitted(schema_of(perceived, registry), contract_with(robot, params))
    assert admitted == fits(perceived, robot, params)


@settings(max_examples=150, deadline=None)
@given(objects("tin"), st.sampled_from(sorted(ROBOTS)))
def test_a_reason_is_stated_for_exactly_the_objects_that_no_grasp_fits(target, robot):
    domains = parameter_domains(msgspec.structs.replace(scene(target, bowl()), robot=robot), ROBOTS[robot])
    named = {name for part in domains["grasp"] for name in part.admitted["object"]}
    assert (why_ungraspable(target, ROBOTS[robot]) == "") == ("tin" in named)


@pytest.mark.parametrize(
    ("obj", "robot", "reason"),
    [
        (box("egg", 0.5, 0.0, fragile_limit=20.0), "ur5e", "bears 20 N.*at least 20 N.*25 N or more"),
        (box("egg", 0.5, 0.0, fragile_limit=20.0), "panda", "^$"),
        (box("chest", 0.6, -0.4, (0.06, 0.06, 0.04)), "panda", "130 mm.* 80 mm"),
    ],
)
def test_the_reason_states_the_force_or_the_width(obj, robot, reason):
    assert re.search(reason, why_ungraspable(obj, ROBOTS[robot]))


def test_an_opening_in_millimetres_that_noise_makes_too_small_is_in_neither():
    """A glass of 48 mm that is perceived at a lean of 1 mrad is 48.1 mm wide."""
    lean = (np.cos(5e-4), np.sin(5e-4), 0.0, 0.0)
    glass = SceneObject(name="glass", role="object", shape=Cylinder(0.024, 0.05), pose=Pose((0.5, 0.0, 0.05), lean))
    perceived = scene(glass, bowl())
    params = GRASP | {"object": "glass", "finger_axis": "across", "opening": 0.058}
    schema = schema_of(perceived, ROBOTS["panda"])
    assert not fits(perceived, "panda", params)
    assert not is_admitted(schema, contract_with("panda", params))
    assert fits(perceived, "panda", params | {"opening": 0.0582})
    assert is_admitted(schema, contract_with("panda", params | {"opening": 0.0582}))


@cache
def grammar_matcher():
    llguidance = pytest.importorskip("llguidance", reason="the extra `planner` is not installed")
    perceived = scene(box("red_cube", 0.5, -0.2), box("plank", 0.45, 0.1, (0.036, 0.0223, 0.025)), BOOK, bowl())
    grammar = actions_grammar(schema_of(perceived, ROBOTS["panda"]))
    matcher = llguidance.LLMatcher(llguidance.LLTokenizer("byte"), llguidance.grammar_from("lark", grammar))
    assert not matcher.is_error(), matcher.get_error()
    return matcher


@pytest.mark.parametrize(
    ("name", "axis", "least"),
    [
        ("red_cube", "along", 0.05),
        ("red_cube", "across", 0.05),
        ("plank", "across", 0.0546),
        ("plank", "along", None),
        ("book", "along", 0.0748),
    ],
)
def test_the_grammar_admits_the_openings_that_fit_the_named_object(name, axis, least):
    """The fingers of the Panda open to 80 mm; the plank is 72 mm by 44.6 mm, the book is 64.8 mm thick."""
    matcher = grammar_matcher()
    order = [parameter.name for parameter in ROBOTS["panda"].skill("grasp").parameters]
    wrong = []
    for millimetres in range(20, 81):
        given_params = GRASP | {"object": name, "finger_axis": axis, "opening": millimetres / 1000}
        action = {"skill": "grasp", "params": {key: given_params[key] for key in order}}
        answer = list((json.dumps([action], separators=(",", ":")) + "}").encode())
        matcher.reset()
        admitted = matcher.try_consume_tokens(answer) == len(answer) and matcher.is_accepting()
        wrong += [millimetres] if admitted != (least is not None and millimetres / 1000 >= least) else []
    assert not wrong


def test_an_object_that_fits_no_hand_is_not_named_and_without_objects_there_is_no_grasp():
    chest = box("chest", 0.6, -0.4, (0.06, 0.06, 0.04))
    egg = box("egg", 0.5, 0.0, fragile_limit=4.0)
    perceived = scene(chest, egg, box("red_cube", 0.5, -0.2), bowl())
    grasp = next(one for one in steps_of(schema_of(perceived, ROBOTS["panda"])) if skill_of(one) == "grasp")
    assert grasp["properties"]["params"]["properties"]["object"]["enum"] == ["red_cube"]
    assert "grasp" not in first_skills(schema_of(scene(chest, egg, bowl()), ROBOTS["panda"]))
    assert "place" in first_skills(schema_of(scene(chest, egg, bowl()), ROBOTS["panda"]))


def steps_of(schema):
    return schema["properties"]["action_sequence"]["items"]["anyOf"]


def skill_of(step):
    return step["properties"]["skill"]["const"]


@pytest.mark.parametrize("robot", ["base", "so101"])
def test_a_robot_without_the_skill_grasp_keeps_its_schema(robot):
    registry = skill_registry(load_robot(robot))
    perceived = scene(places=[("dock", (1.0, 0.0, 0.0))])
    assert parameter_domains(perceived, registry) == {}


def test_parts_of_a_domain_keep_the_names_of_the_scene_and_the_order_of_the_parameters():
    names = SceneNames(("red_cube",), ("blue_bowl",))
    parts = [
        ParameterDomain({"object": ("red_cube", "gone")}, {"opening": 0.06}),
        ParameterDomain({"object": ("gone",)}),
    ]
    schema = decoding_schema(ROBOTS["panda"], names, domains={"grasp": parts})
    params = next(one for one in steps_of(schema) if skill_of(one) == "grasp")["properties"]["params"]
    assert list(params["properties"]) == [one.name for one in ROBOTS["panda"].skill("grasp").parameters]
    assert params["properties"]["object"] == {"enum": ["red_cube"]}
    assert params["properties"]["opening"] == {"type": "number", "minimum": 0.06, "maximum": 0.08}
    place = next(one for one in steps_of(schema) if skill_of(one) == "place")["properties"]["params"]
    assert list(place["properties"]) == list(PLACE)


# --- goals whose objects do not fit the hand ----------------------------------------------------------------------

GREEN_BOX = box("green_box", 0.3, -0.35, (0.06, 0.06, 0.03))
"""A box of 120 mm: it fits the hand along no axis."""


def situation(*objects, holding=None):
    perceived = scene(box("red_cube", 0.5, -0.2), *(objects or (GREEN_BOX,)), bowl())
    return PlanningContext(
        robot_model=load_robot("panda"), scene=perceived, holding=holding, posture=Posture((0.0,) * 7, 0.04)
    )


DECLINE = '{"skill":"decline","params":{"reason":"it is too wide"}}'


def admits(schema, *actions):
    """Whether the grammar of the answers admits the actions."""
    llguidance = pytest.importorskip("llguidance", reason="the extra `planner` is not installed")
    matcher = llguidance.LLMatcher(
        llguidance.LLTokenizer("byte"), llguidance.grammar_from("lark", actions_grammar(schema))
    )
    assert not matcher.is_error(), matcher.get_error()
    answer = list(f"[{','.join(actions)}]}}".encode())
    return matcher.try_consume_tokens(answer) == len(answer) and matcher.is_accepting()


@pytest.mark.parametrize(
    "instruction",
    [
        "put the green box in the blue bowl",
        "pick up the green box",
        "put the red cube and the green box in the blue bowl",
        "put all boxes in the blue bowl",
    ],
)
def test_a_goal_whose_object_does_not_fit_leaves_the_decline(instruction):
    context = situation()
    schema = answer_schema(instruction, context.scene, context.registry, None)
    assert first_skills(schema) == ("decline",)
    assert admits(schema, DECLINE)
    proposal = Proposal(text=decline_contract("it is too wide"), finish_reason="stop", planner="x", timings={})
    assert reject_mismatch(proposal, instruction, context, reject_decline=True) is None


def test_a_decline_of_an_object_that_fits_is_rejected_once_and_an_object_at_its_place_need_not_be_grasped():
    proposal = Proposal(text=decline_contract("no"), finish_reason="stop", planner="x", timings={})
    fits = situation()
    assert reject_mismatch(proposal, "put the red cube in the blue bowl", fits, reject_decline=True) is not None
    inside = situation(box("green_box", 0.5, 0.26, (0.06, 0.06, 0.03), z=0.03))
    schema = answer_schema("put the green box and the red cube in the blue bowl", inside.scene, inside.registry, None)
    assert "grasp" in first_skills(schema)
    held = situation(holding="green_box")
    assert "place" in first_skills(
        answer_schema("put the green box in the blue bowl", held.scene, held.registry, "green_box")
    )


def test_an_alternative_without_a_sequence_is_left_out():
    """With an empty hand a placement needs a grasp. Engines refuse a schema with an alternative that admits nothing."""
    names, registry = SceneNames(("red_cube",), ("blue_bowl",)), ROBOTS["panda"]
    order = skill_order([skill.name for skill in registry.skills], None)
    goal = {"order": order, "skills": ("grasp", "place", "decline"), "length": (2, 2)}
    assert first_skills(decoding_schema(registry, names, **goal)) == ("grasp", "decline")
    assert admits(decoding_schema(registry, names, domains={"grasp": ()}, **goal), DECLINE)
    assert first_skills(decoding_schema(registry, names, domains={"grasp": ()}, **goal)) == ("decline",)
