"""The orders of skills that the decoder admits are those that the gate's rules about hand and decline accept."""

from functools import cache

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.schema import decoding_schema, first_skills
from dualbrain.grounding.envelope.scene_rules import scene_rules, skill_order
from dualbrain.planner.decoding.llguidance_grammar import actions_grammar
from dualbrain.records import Scene
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.skills.arm.controller import ArmController
from dualbrain.skills.registry import skill_registry
from dualbrain.skills.skill import HeldObject

PANDA = load_robot("panda")
REGISTRY = skill_registry(PANDA)
SKILLS = [skill.name for skill in REGISTRY.skills]
NAMES = SceneNames(("red_cube",), ("blue_bowl",))
SEQUENCES = st.lists(st.sampled_from(SKILLS), min_size=1, max_size=8)
HELD = [None, "red_cube"]
ACTION = {
    "grasp": '{"object":"red_cube","speed":0.2,"clearance":0.15,"finger_axis":"along","opening":0.08,"approach":"top",'
    '"wait":"none","force":15}',
    "place": '{"destination":"blue_bowl","speed":0.2,"clearance":0.15,"route":"direct","wait":"none"}',
    "move_to": '{"target":"blue_bowl","speed":0.2,"clearance":0.15,"route":"direct","wait":"none"}',
    "home": '{"speed":0.2}',
    "decline": '{"reason":"no"}',
}
"""Parameters of some skills, in the form in which a decoder writes them."""


@cache
def hand_and_decline_rules(held):
    arm = ArmController(PANDA, SafetyFilter(PANDA))
    arm.holding = HeldObject(held, 0.05) if held else None
    decline, hand, *_ = scene_rules(Scene(robot="panda", stamp=0.0, version=1, objects=()), arm)
    return decline, hand


def is_accepted(skills, held):
    """Whether the gate's rules about hand and decline accept a contract with `skills`."""
    contract = Contract("c-0001", Context("panda", ""), tuple(Action(skill, {}) for skill in skills))
    return all(rule(contract) is None for rule in hand_and_decline_rules(held))


@pytest.mark.parametrize("held", HELD)
def test_the_first_actions_are_those_that_the_gate_accepts(held):
    admitted = first_skills(decoding_schema(REGISTRY, NAMES, order=skill_order(SKILLS, held)))
    assert admitted == tuple(skill for skill in SKILLS if is_accepted([skill], held))
    assert ("grasp" in admitted) == (held is None)
    assert ("place" in admitted) == (held is not None)


@settings(max_examples=300)
@given(SEQUENCES, st.sampled_from(HELD))
def test_the_order_admits_exactly_what_the_rules_accept(skills, held):
    assert skill_order(SKILLS, held).admits(skills) == is_accepted(skills, held)


@settings(max_examples=150)
@given(st.lists(st.sampled_from(sorted(ACTION)), min_size=1, max_size=9), st.sampled_from(HELD), st.booleans())
def test_the_grammar_admits_every_accepted_contract_and_no_other(skills, held, bounded):
    text = ",".join(f'{{"skill":"{skill}","params":{ACTION[skill]}}}' for skill in skills)
    matcher = grammar_matcher(held, bounded)
    matcher.reset()
    answer = list(f"[{text}]}}".encode())
    admitted = matcher.try_consume_tokens(answer) == len(answer) and matcher.is_accepting()
    fits = skills == ["decline"] or 2 <= len(skills) <= 3 if bounded else len(skills) <= 8
    assert admitted == (is_accepted(skills, held) and fits)


@cache
def grammar_matcher(held, bounded):
    llguidance = pytest.importorskip("llguidance", reason="the extra `planner` is not installed")
    schema = decoding_schema(REGISTRY, NAMES, order=skill_order(SKILLS, held), length=(2, 3) if bounded else None)
    grammar = llguidance.grammar_from("lark", actions_grammar(schema))
    matcher = llguidance.LLMatcher(llguidance.LLTokenizer("byte"), grammar)
    assert not matcher.is_error(), matcher.get_error()
    return matcher


def test_an_object_in_the_hand_is_no_destination():
    """Objects and destinations have no name in common, so a schema with the names of the scene admits no such place."""
    steps = decoding_schema(REGISTRY, NAMES, order=skill_order(SKILLS, "red_cube"))["properties"]["action_sequence"]
    place = next(one for one in steps["items"]["anyOf"] if one["properties"]["skill"]["const"] == "place")
    assert place["properties"]["params"]["properties"]["destination"]["enum"] == ["blue_bowl"]
