"""Envelope rules of a scene: each refuses what it says, with pointer and way out, and nothing else."""

import msgspec
import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.grounding.offline_gate import check_contract, controller_at_home
from dualbrain.grounding.scene_rules import FINGER_MARGIN, scene_rules
from dualbrain.robots.loader import load_robot
from dualbrain.skills.skill import HeldObject
from tests.grounding.perceived_scenes import bowl, box, scene
from tests.stories.story_session import GRASP, PLACE, REGISTRY, contract_text, decline_contract, hold_contract


@pytest.fixture(scope="module")
def seen():
    return scene(
        box("red_cube", 0.5, -0.2),
        box("far_cube", 1.6, 0.0),
        box("plank", 0.45, 0.1, (0.036, 0.02, 0.025)),
        box("chest", 0.6, -0.4, (0.06, 0.06, 0.04)),
        bowl(),
    )


@pytest.fixture(scope="module")
def limb(seen):
    return controller_at_home("panda", seen)


def verdict(seen, limb, *actions):
    sequence = tuple(Action(skill, params) for skill, params in actions)
    made = Contract("c-1", Context("panda", REGISTRY), sequence)
    found = [rule(made) for rule in scene_rules(seen, limb)]
    return next((refusal for refusal in found if refusal), None)


def grasp(**changes):
    return ("grasp", {**GRASP, **changes})


place, release, home = ("place", PLACE), ("release", {"speed": 0.1}), ("home", {"speed": 0.2})


@pytest.mark.parametrize(
    "actions",
    [
        (grasp(), place),
        (grasp(), release),
        (grasp(), place, grasp(), place),
        (grasp(), release, grasp(), home),
        (home,),
        (release,),
        (("decline", {"reason": "no"}),),
        (grasp(object="plank", finger_axis="across", opening=0.055),),
    ],
)
def test_what_is_possible_passes(seen, limb, actions):
    assert verdict(seen, limb, *actions) is None


@pytest.mark.parametrize(
    ("actions", "pointer", "way_out"),
    [
        ((home, ("decline", {"reason": "no"})), "/action_sequence", "alone"),
        ((place,), "/action_sequence/0/skill", "grasp something first"),
        ((grasp(), grasp()), "/action_sequence/1/skill", "full"),
        ((grasp(), place, place), "/action_sequence/2/skill", "nothing is held"),
        ((grasp(), release, place), "/action_sequence/2/skill", "nothing is held"),
        ((grasp(opening=0.045),), "/action_sequence/0/params/opening", "wider"),
        ((grasp(object="chest", opening=0.08),), "/action_sequence/0/params/opening", "too wide for this hand"),
        ((grasp(object="plank", opening=0.08),), "/action_sequence/0/params/opening", "too wide for this hand"),
        ((grasp(object="far_cube"),), "/action_sequence/0/params/object", "out of reach"),
        ((grasp(), place, grasp(object="far_cube")), "/action_sequence/2/params/object", "out of reach"),
    ],
)
def test_what_is_impossible_is_refused_with_the_reason(seen, limb, actions, pointer, way_out):
    refusal = verdict(seen, limb, *actions)
    assert (refusal.stage, refusal.pointer) == ("envelope", pointer)
    assert way_out in refusal.hint
    assert refusal.allowed


def test_a_full_hand_turns_the_order_round(seen):
    limb = controller_at_home("panda", seen)
    limb.holding = HeldObject("red_cube", 0.03)
    assert verdict(seen, limb, place) is None
    assert "full" in verdict(seen, limb, grasp()).hint


def test_the_opening_that_a_refusal_asks_for_is_enough(seen, limb):
    refusal = verdict(seen, limb, grasp(opening=0.045))
    assert refusal.allowed["minimum"] == pytest.approx(0.04 + FINGER_MARGIN)
    assert verdict(seen, limb, grasp(opening=refusal.allowed["minimum"])) is None


def test_reach_is_not_prejudice(seen, limb):
    """On a grid over the near half of the table every thing can be grasped from above."""
    for x in (0.35, 0.5, 0.65):
        for y in (-0.3, 0.0, 0.3):
            things = scene(box("red_cube", x, y), bowl())
            assert verdict(things, controller_at_home("panda", things), grasp()) is None, (x, y)


# --- the desk -----------------------------------------------------------------------------------------------------


def desk(text):
    return msgspec.to_builtins(check_contract(text.encode(), robot="panda", scene="bare:0"))


def test_the_desk_says_what_the_gate_says():
    assert desk(contract_text(grasp(), place))["verdict"] == "accepted"
    assert desk(hold_contract())["verdict"] == "accepted"
    assert desk(decline_contract())["verdict"] == "accepted"
    assert desk("{")["stage"] == "syntax"
    assert desk(contract_text(grasp(), place, registry="00000000"))["stage"] == "authorization"
    assert desk(contract_text(grasp(opening=0.045), place))["pointer"] == "/action_sequence/0/params/opening"
    assert desk(contract_text(place))["pointer"] == "/action_sequence/0/skill"


def test_the_arm_on_the_desk_stands_at_home(seen, limb):
    assert tuple(limb.observation.state.q) == load_robot("panda").home
    assert limb.observation.scene is seen


def test_a_height_the_arm_does_not_reach_is_refused_and_the_allowed_one_passes():
    turned = scene(box("red_cube", 0.6, -0.2, yaw=0.6), bowl())
    arm = controller_at_home("panda", turned)
    wish = {"clearance": 0.35, "approach": "side", "finger_axis": "across"}
    refusal = verdict(turned, arm, grasp(**wish), place)
    assert refusal is not None
    assert (refusal.stage, refusal.pointer, refusal.got) == ("envelope", "/action_sequence/0/params/clearance", 0.35)
    assert 0.03 <= refusal.allowed["maximum"] < 0.35
    assert verdict(turned, arm, grasp(**wish | {"clearance": refusal.allowed["maximum"]}), place) is None


def test_an_approach_the_arm_cannot_take_is_refused_with_those_it_can():
    turned = scene(box("red_cube", 0.6, -0.2, yaw=0.6), bowl())
    arm = controller_at_home("panda", turned)
    wish = {"clearance": 0.1, "approach": "side", "finger_axis": "along"}
    refusal = verdict(turned, arm, grasp(**wish), place)
    assert refusal is not None
    assert (refusal.pointer, refusal.allowed) == ("/action_sequence/0/params/approach", ["top", "tilted"])
    for way in refusal.allowed:
        assert verdict(turned, arm, grasp(**wish | {"approach": way}), place) is None
