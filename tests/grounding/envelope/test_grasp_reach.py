"""The clearances and approaches that the decoder admits are those from which the gate lets the arm come down."""

from functools import cache

import jsonschema_rs
import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.contracts.parameter_domains import ParameterDomain
from dualbrain.contracts.schema import decoding_schema
from dualbrain.grounding.envelope.grasp_fit import parameter_domains
from dualbrain.grounding.envelope.grasp_reach import arm_in_posture, comes_down, highest_clearance, within_reach
from dualbrain.grounding.envelope.scene_rules import scene_rules
from dualbrain.grounding.offline_gate import controller_at_home, scene_from_spec
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.records import RetrievedContext
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.runtime.planning.planner_request import PlanningContext, build_request
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.skills.kinematics.object_geometry import APPROACH_LEAN
from dualbrain.skills.registry import skill_registry
from tests.grounding.perceived_scenes import bowl, box, scene
from tests.stories.story_session import GRASP, PLACE

ROBOTS = {name: skill_registry(load_robot(name)) for name in ("panda", "ur5e")}
HIGH = {"object": "red_cube", "finger_axis": "along", "approach": "tilted", "clearance": 0.25}
"""A grasp at the edge of the reach of a UR5e in scene edge:40402, with which a planner was rejected."""


@cache
def model(robot):
    return load_robot(robot)


def at_home(robot, perceived):
    state = home_state(model(robot))
    return arm_in_posture(model(robot), perceived, state.q.tolist(), state.opening)


def schema_of(robot, perceived, graspable=None):
    domains = parameter_domains(perceived, ROBOTS[robot])
    reached = within_reach(domains, perceived, at_home(robot, perceived), graspable or perceived.graspable)
    return decoding_schema(ROBOTS[robot], scene_names(perceived), domains=reached)


def grasp_contract(robot, perceived, **params):
    opening = {"panda": 0.08, "ur5e": 0.085}[robot]
    action = Action("grasp", GRASP | {"opening": opening, "force": 25.0} | params)
    return Contract("c-0001", Context(robot, ROBOTS[robot].hash), (action,))


def is_admitted(schema, contract):
    return jsonschema_rs.validator_for(schema).is_valid(msgspec.to_builtins(contract))


def rejection(robot, perceived, contract):
    rules = scene_rules(perceived, controller_at_home(robot, perceived))
    return next((found for rule in rules if (found := rule(contract))), None)


@pytest.fixture(params=["panda", "ur5e"])
def robot(request):
    return request.param


@settings(max_examples=60, deadline=None)
@given(
    robot=st.sampled_from(sorted(ROBOTS)),
    radius=st.floats(0.3, 0.95),
    angle=st.floats(-1.2, 1.2),
    axis=st.sampled_from(["along", "across"]),
    approach=st.sampled_from(sorted(APPROACH_LEAN)),
    clearance=st.floats(0.03, 0.35) | st.integers(3, 35).map(lambda count: count / 100),
)
def test_no_grasp_within_reach_is_lost_and_an_approach_from_too_high_is_not_admitted(
    robot, radius, angle, axis, approach, clearance
):
    cube = box("cube", radius * np.cos(angle), radius * np.sin(angle), (0.02, 0.02, 0.02))
    perceived = msgspec.structs.replace(scene(cube, bowl()), robot=robot)
    contract = grasp_contract(robot, perceived, object="cube", finger_axis=axis, approach=approach, clearance=clearance)
    admitted, found = is_admitted(schema_of(robot, perceived), contract), rejection(robot, perceived, contract)
    if found is None:
        assert admitted
    arm = at_home(robot, perceived)
    highest = highest_clearance(arm, cube, axis, approach)
    if highest is not None:
        assert admitted == (clearance <= highest)
        assert comes_down(arm, cube, axis, approach, highest)
    if found is not None and found.pointer.endswith("clearance"):
        nearer = grasp_contract(
            robot, perceived, object="cube", finger_axis=axis, approach=approach, clearance=found.allowed["maximum"]
        )
        assert rejection(robot, perceived, nearer) is None
        assert found.allowed["maximum"] < clearance


def test_the_decoder_cannot_write_a_grasp_from_too_high_at_the_edge_of_the_reach():
    perceived = scene_from_spec(open_scene("edge:40402", "ur5e"))
    contract = grasp_contract("ur5e", perceived, **HIGH)
    found = rejection("ur5e", perceived, contract)
    assert found.pointer == "/action_sequence/0/params/clearance"
    assert not is_admitted(schema_of("ur5e", perceived), contract)
    lower = grasp_contract("ur5e", perceived, **HIGH | {"clearance": found.allowed["maximum"]})
    assert is_admitted(schema_of("ur5e", perceived), lower)
    assert rejection("ur5e", perceived, lower) is None


def test_an_object_that_no_grasp_reaches_keeps_its_parts_and_the_gate_states_the_reason(robot):
    far = box("cube", 1.6, 0.0, (0.02, 0.02, 0.02))
    perceived = msgspec.structs.replace(scene(far, bowl()), robot=robot)
    contract = grasp_contract(robot, perceived, object="cube", clearance=0.3)
    assert is_admitted(schema_of(robot, perceived), contract)
    assert "out of reach" in rejection(robot, perceived, contract).hint


def test_a_least_clearance_above_the_reach_keeps_the_part_and_the_gate_states_the_reason():
    far = box("cube", 0.8, 0.0, (0.02, 0.02, 0.02))
    perceived, arm = scene(far, bowl()), at_home("panda", scene(far, bowl()))
    heights = [highest_clearance(arm, far, "along", approach) for approach in APPROACH_LEAN]
    assert [height for height in heights if height is not None] == [heights[0]]
    assert heights[0] < 0.3
    part = ParameterDomain({"object": ["cube"], "finger_axis": ("along",)}, {"clearance": 0.3})
    (kept,) = within_reach({"grasp": (part,)}, perceived, arm, ["cube"])["grasp"]
    assert (kept.admitted, kept.least, kept.most) == (part.admitted, part.least, {})
    assert rejection("panda", perceived, grasp_contract("panda", perceived, object="cube", clearance=0.32)) is not None


def test_only_the_objects_of_the_goal_are_computed(robot):
    perceived = scene_from_spec(open_scene("edge:40402", robot))
    domains = parameter_domains(perceived, ROBOTS[robot])
    reached = within_reach(domains, perceived, at_home(robot, perceived), ["red_cube"])
    assert {name for part in reached["grasp"] for name in part.admitted["object"]} == {"red_cube"}
    assert within_reach({}, perceived, at_home(robot, perceived), ["red_cube"]) == {}


def test_the_request_to_a_planner_states_the_reach_of_the_arm():
    perceived, state = scene_from_spec(open_scene("edge:40402", "ur5e")), home_state(model("ur5e"))
    context = PlanningContext(
        robot_model=model("ur5e"),
        scene=perceived,
        holding=None,
        posture=Posture(tuple(state.q.tolist()), state.opening),
    )
    schema = build_request("put the red cube in the blue bowl", context, RetrievedContext()).schema
    place = Action("place", PLACE)
    high = grasp_contract("ur5e", perceived, **HIGH)
    both = msgspec.structs.replace(high, action_sequence=(*high.action_sequence, place))
    top = grasp_contract("ur5e", perceived, **HIGH | {"approach": "top"})
    assert not is_admitted(schema, both)
    assert is_admitted(schema, msgspec.structs.replace(top, action_sequence=(*top.action_sequence, place)))


def test_a_mobile_robot_states_no_reach():
    robot_model = load_robot("mobile_panda")
    state = home_state(robot_model)
    context = PlanningContext(
        robot_model=robot_model,
        scene=scene_from_spec(open_scene("workroom:1", "mobile_panda")),
        holding=None,
        posture=Posture(tuple(state.q.tolist()), state.opening),
    )
    assert context.make_arm() is None
