"""The first actions that the decoder admits are those that the gate's rule about the hand admits."""

import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.schema import decoding_schema, first_skills
from dualbrain.grounding.scene_rules import scene_rules, skills_refused_first
from dualbrain.records import Scene
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.skills.arm.controller import ArmController
from dualbrain.skills.registry import skill_registry
from dualbrain.skills.skill import HeldObject

PANDA = load_robot("panda")
NAMES = SceneNames(("red_cube",), ("blue_bowl",))


@pytest.mark.parametrize("held", [None, "red_cube"])
def test_the_grammar_offers_first_what_the_gate_does_not_refuse_for_the_hand(held):
    arm = ArmController(PANDA, SafetyFilter(PANDA))
    arm.holding = HeldObject(held, 0.05) if held else None
    registry = skill_registry(PANDA)
    _, hand_order, _ = scene_rules(Scene(robot="panda", stamp=0.0, version=1, objects=()), arm)
    admitted = tuple(
        skill.name
        for skill in registry.skills
        if hand_order(Contract("c-0001", Context("panda", ""), (Action(skill.name, {}),))) is None
    )
    assert first_skills(decoding_schema(registry, NAMES, not_first=skills_refused_first(held))) == admitted
    assert ("grasp" in admitted) == (held is None)
    assert ("place" in admitted) == (held is not None)
