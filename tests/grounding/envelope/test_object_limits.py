"""Limits of a site on named objects: in the scene, in the gate, in the decoder, and in what the arm does."""

import jsonschema_rs
import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.contracts.schema import decoding_schema
from dualbrain.grounding.envelope.grasp_fit import parameter_domains
from dualbrain.grounding.envelope.object_limits import (
    absent_persons_in_words,
    check_object_limits,
    limits_in_words,
    site_object_limits,
    with_object_limits,
)
from dualbrain.grounding.envelope.scene_rules import scene_rules
from dualbrain.grounding.offline_gate import controller_at_home
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.records import ObjectLimits
from dualbrain.robots.loader import load_robot
from dualbrain.robots.site_config import SiteError, read_site
from dualbrain.runtime.planning.planner_request import answer_schema
from dualbrain.safety.cbf.obstacles import PersonLimits
from dualbrain.skills.mobile_manipulator import MobileManipulatorController
from dualbrain.skills.registry import skill_registry
from dualbrain.skills.skill import HeldObject
from tests.grounding.perceived_scenes import bowl, box, scene

REGISTRY = skill_registry(load_robot("panda"))
CUBE = box("red_cube", 0.5, -0.2, (0.02, 0.02, 0.02), category="cube")
BLOCK = box("green_block", 0.45, 0.1, (0.02, 0.03, 0.02), category="block")
SCENE = scene(CUBE, BLOCK, bowl())
LIMITS = ObjectLimits(force=8.0, speed=0.08, clearance=0.3, source="lab.toml:3")
GRASP = {
    "object": "red_cube",
    "speed": 0.2,
    "clearance": 0.3,
    "finger_axis": "along",
    "opening": 0.08,
    "approach": "top",
    "wait": "none",
    "force": 15.0,
}
PLACE = {"destination": "blue_bowl", "speed": 0.2, "clearance": 0.3, "route": "direct", "wait": "none"}
MOVE = {"target": "blue_bowl", "speed": 0.2, "clearance": 0.3, "route": "direct", "wait": "none"}
PUSH = {"object": "red_cube", "destination": "blue_bowl", "distance": 0.1, "speed": 0.2}
PUSH |= {"clearance": 0.3, "wait": "none"}
SLOW_GRASP = GRASP | {"force": 8.0, "speed": 0.08}
NUMBERS = {"force": st.floats(5.0, 60.0), "speed": st.floats(0.05, 0.4), "clearance": st.floats(0.03, 0.35)}


def contract(*steps):
    actions = tuple(Action(skill, params) for skill, params in steps)
    return Contract("c-0001", Context("panda", REGISTRY.hash), actions)


@st.composite
def limited_scenes(draw):
    """The scene with any limits for its two objects."""
    limits = {
        name: ObjectLimits(**{limit: draw(st.none() | values) for limit, values in NUMBERS.items()})
        for name in ("red_cube", "green_block")
    }
    return with_object_limits(SCENE, limits)


def site(folder, text):
    path = folder / "lab.toml"
    path.write_text(text)
    return read_site(path)


@pytest.mark.parametrize(
    ("steps", "pointer"),
    [
        ([("grasp", GRASP | {"speed": 0.08})], "/action_sequence/0/params/force"),
        ([("grasp", GRASP | {"force": 8.0})], "/action_sequence/0/params/speed"),
        ([("grasp", SLOW_GRASP | {"clearance": 0.29})], "/action_sequence/0/params/clearance"),
        ([("grasp", SLOW_GRASP), ("place", PLACE)], "/action_sequence/1/params/speed"),
        (
            [("grasp", SLOW_GRASP), ("home", {"speed": 0.2})],
            "/action_sequence/1/params/speed",
        ),
        ([("home", {"speed": 0.2}), ("push", PUSH)], "/action_sequence/1/params/speed"),
        ([("grasp", SLOW_GRASP)], None),
        ([("grasp", GRASP | {"object": "green_block"}), ("place", PLACE), ("home", {"speed": 0.4})], None),
        ([("move_to", MOVE), ("grasp", SLOW_GRASP)], None),
        (
            [
                ("grasp", SLOW_GRASP),
                ("place", PLACE | {"speed": 0.08}),
                ("home", {"speed": 0.4}),
            ],
            None,
        ),
    ],
)
def test_the_gate_rejects_the_first_number_beyond_a_limit_while_the_object_is_moved(steps, pointer):
    limited = with_object_limits(SCENE, {"red_cube": LIMITS})
    found = check_object_limits(contract(*steps), limited, None)
    assert (found and found.pointer) == pointer
    if found:
        assert found.stage == "envelope"
        assert "red_cube: force at most 8 N, speed at most 0.08 m/s, clearance at least 0.3 m" in found.hint
        assert "lab.toml:3" in found.hint


def test_an_object_in_the_hand_keeps_its_limits():
    limited = with_object_limits(SCENE, {"red_cube": LIMITS})
    moving = contract(("move_to", MOVE))
    assert check_object_limits(moving, limited, None) is None
    assert check_object_limits(moving, limited, "green_block") is None
    found = check_object_limits(moving, limited, "red_cube")
    assert found is not None
    assert found.allowed == {"maximum": 0.08}


def test_a_drive_with_the_object_in_the_hand_keeps_its_speed():
    limited = with_object_limits(SCENE, {"red_cube": ObjectLimits(speed=0.2)})
    drive = ("drive_to", {"place": "blue_bowl", "max_speed": 0.4, "max_turn_rate": 0.5})
    carried = check_object_limits(contract(("grasp", GRASP), drive), limited, None)
    assert carried is not None
    assert (carried.pointer, carried.allowed) == ("/action_sequence/1/params/max_speed", {"maximum": 0.2})
    assert check_object_limits(contract(drive, ("grasp", GRASP)), limited, None) is None


def rejected_pointers(robot, steps, holding):
    """The places that the rules of `robot` reject in a contract, with the object `holding` in the hand."""
    limited = with_object_limits(SCENE, {"red_cube": LIMITS})
    controller = controller_at_home(robot, limited)
    arm = controller.arm if isinstance(controller, MobileManipulatorController) else controller
    arm.holding = HeldObject(holding, 0.02) if holding else None
    return {found.pointer for rule in scene_rules(limited, controller) if (found := rule(contract(*steps)))}


@pytest.mark.parametrize("robot", ["panda", "mobile_panda"])
def test_the_rules_of_an_arm_include_the_limits(robot):
    assert "/action_sequence/0/params/force" in rejected_pointers(robot, [("grasp", GRASP | {"speed": 0.08})], None)
    homing, speed = [("home", {"speed": 0.2})], "/action_sequence/0/params/speed"
    assert speed in rejected_pointers(robot, homing, "red_cube")
    assert speed not in rejected_pointers(robot, homing, "green_block")
    assert speed not in rejected_pointers(robot, homing, None)


def test_name_and_category_apply_together_and_others_to_the_rest():
    limits = {
        "red_cube": ObjectLimits(force=10.0, clearance=0.1),
        "cube": ObjectLimits(force=20.0, speed=0.1, clearance=0.2),
        "others": ObjectLimits(force=30.0),
    }
    limited = with_object_limits(SCENE, limits)
    assert limited.find("red_cube").limits == ObjectLimits(force=10.0, speed=0.1, clearance=0.2)
    assert limited.find("green_block").limits == ObjectLimits(force=30.0)
    assert limited.find("blue_bowl").limits is None
    assert with_object_limits(limited, limits) == limited
    stated = msgspec.structs.replace(CUBE, limits=ObjectLimits(force=float("nan"), speed=9.0))
    assert with_object_limits(scene(stated, BLOCK, bowl()), limits).find("red_cube") == limited.find("red_cube")


def test_a_scene_without_limits_is_the_same_object():
    assert with_object_limits(SCENE, {}) is SCENE


def test_words_name_the_limited_objects_and_the_entries_without_an_object():
    limits = {"red_cube": LIMITS, "glass": ObjectLimits(speed=0.1, source="lab.toml:9")}
    lines = limits_in_words(with_object_limits(SCENE, limits), limits)
    assert lines[0].startswith("limits of the site for red_cube: force at most 8 N")
    assert "'glass'" in lines[1]
    assert len(lines) == 2


def test_words_name_the_entries_of_persons_without_a_person():
    ada = msgspec.structs.replace(box("Ada", 0.4, 0.4, (0.1, 0.1, 0.1)), role="person")
    persons = PersonLimits(named=frozenset({"Ada", "Bo", "red_cube", "others"}))
    lines = absent_persons_in_words(scene(CUBE, ada), persons)
    assert [line.partition(" of ")[0] for line in lines] == [
        f"no person in this scene has the name {name!r}" for name in ("Bo", "red_cube")
    ]
    assert all(line.endswith("persons in it: Ada") for line in lines)
    assert absent_persons_in_words(SCENE, persons)[0].endswith("it has no person")
    assert absent_persons_in_words(SCENE, None) == ()


@given(data=st.data())
@settings(max_examples=150, deadline=None)
def test_the_decoder_admits_the_grasps_and_pushes_within_the_limits_alone(data):
    limited = data.draw(limited_scenes())
    schema = decoding_schema(REGISTRY, scene_names(limited), domains=parameter_domains(limited, REGISTRY))
    skill, base = data.draw(st.sampled_from([("grasp", GRASP), ("push", PUSH)]))
    drawn = {name: data.draw(values, label=name) for name, values in NUMBERS.items() if name in base}
    moved = data.draw(st.sampled_from(["red_cube", "green_block"]))
    asked = contract((skill, base | drawn | {"object": moved}))
    admitted = jsonschema_rs.validator_for(schema).is_valid(msgspec.to_builtins(asked))
    assert admitted == (check_object_limits(asked, limited, None) is None)


@given(data=st.data())
@settings(max_examples=150, deadline=None)
def test_the_decoder_loses_no_place_that_the_gate_accepts(data):
    limited = data.draw(limited_scenes())
    holding = data.draw(st.sampled_from(["red_cube", "green_block"]))
    domains = parameter_domains(limited, REGISTRY, holding, ())
    schema = decoding_schema(REGISTRY, scene_names(limited), domains=domains)
    drawn = {name: data.draw(NUMBERS[name], label=name) for name in ("speed", "clearance")}
    placed = contract(("place", PLACE | drawn))
    exact = jsonschema_rs.validator_for(schema).is_valid(msgspec.to_builtins(placed))
    accepted = check_object_limits(placed, limited, holding) is None
    assert exact == accepted
    loose = decoding_schema(REGISTRY, scene_names(limited), domains=parameter_domains(limited, REGISTRY))
    if accepted:
        assert jsonschema_rs.validator_for(loose).is_valid(msgspec.to_builtins(placed))


@pytest.mark.parametrize(
    ("speed", "clearance", "admitted"), [(0.25, 0.15, True), (0.35, 0.15, False), (0.25, 0.05, False)]
)
def test_a_place_of_an_unknown_object_has_the_loosest_limits(speed, clearance, admitted):
    limits = {"cube": ObjectLimits(speed=0.1, clearance=0.1), "block": ObjectLimits(speed=0.3, clearance=0.3)}
    limited = with_object_limits(SCENE, limits)
    schema = decoding_schema(REGISTRY, scene_names(limited), domains=parameter_domains(limited, REGISTRY))
    placed = contract(("place", PLACE | {"speed": speed, "clearance": clearance}))
    assert jsonschema_rs.validator_for(schema).is_valid(msgspec.to_builtins(placed)) is admitted


def test_the_schema_of_an_answer_bounds_the_place_of_the_named_object():
    limited = with_object_limits(SCENE, {"red_cube": LIMITS})
    steps = (("grasp", SLOW_GRASP), ("place", PLACE))
    fast, slow = contract(*steps), contract(steps[0], ("place", PLACE | {"speed": 0.08}))
    schema = answer_schema("put the red cube in the blue bowl", limited, REGISTRY, None)
    validator = jsonschema_rs.validator_for(schema)
    assert not validator.is_valid(msgspec.to_builtins(fast))
    assert validator.is_valid(msgspec.to_builtins(slow))


def test_a_site_file_states_limits_with_their_lines(tmp_path):
    file = site(tmp_path, "[object.red_cube]\nforce = 8.0\n\n[object.cube]\nspeed = 0.1\nclearance = 0.2\n")
    assert site_object_limits(file, REGISTRY) == {
        "red_cube": ObjectLimits(force=8.0, source="lab.toml:1"),
        "cube": ObjectLimits(speed=0.1, clearance=0.2, source="lab.toml:4"),
    }


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("[object.red_cube]\nforce = 3.0\n", 2, "at least 5 N"),
        ("[object.red_cube]\nclearance = 0.5\n", 2, "at most 0.35 m"),
        ("[object.red_cube]\nspeed = 0.01\n", 2, "at least 0.05 m/s"),
    ],
)
def test_a_limit_that_no_grasp_keeps_is_an_error(tmp_path, text, line, words):
    with pytest.raises(SiteError) as raised:
        site_object_limits(site(tmp_path, text), REGISTRY)
    assert raised.value.line == line
    assert words in str(raised.value)


@pytest.mark.parametrize(
    "text", ["[object.red_cube]\nforce = 0.0\n", "[object.red_cube]\nforces = 8.0\n", "[object]\nforce = 8.0\n"]
)
def test_wrong_entries_are_errors(tmp_path, text):
    with pytest.raises(SiteError, match=r"object"):
        site(tmp_path, text)


def test_a_robot_without_a_hand_ignores_the_limits(tmp_path):
    base = skill_registry(load_robot("base"))
    assert site_object_limits(site(tmp_path, "[object.red_cube]\nforce = 3.0\n"), base)
