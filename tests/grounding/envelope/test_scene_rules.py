"""Scene rules of the gate: each rejects an infeasible contract with a pointer and a hint, and accepts feasible ones."""

import msgspec
import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.core.geometry.shapes import Pose
from dualbrain.grounding.envelope.grasp_fit import FINGER_MARGIN
from dualbrain.grounding.envelope.scene_rules import scene_rules
from dualbrain.grounding.offline_gate import check_contract, controller_at_home
from dualbrain.robots.loader import load_robot
from dualbrain.skills.skill import HeldObject
from tests.grounding.perceived_scenes import bowl, box, scene
from tests.stories.story_session import GRASP, PLACE, REGISTRY, contract_text, decline_contract, hold_contract


@pytest.fixture(scope="module")
def perceived():
    return scene(
        box("red_cube", 0.5, -0.2),
        box("far_cube", 1.6, 0.0),
        box("plank", 0.45, 0.1, (0.036, 0.02, 0.025)),
        box("chest", 0.6, -0.4, (0.06, 0.06, 0.04)),
        bowl(),
    )


@pytest.fixture(scope="module")
def arm(perceived):
    return controller_at_home("panda", perceived)


def verdict(perceived, arm, *actions):
    sequence = tuple(Action(skill, params) for skill, params in actions)
    contract = Contract("c-1", Context("panda", REGISTRY), sequence)
    results = [rule(contract) for rule in scene_rules(perceived, arm)]
    return next((rejected for rejected in results if rejected), None)


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
def test_a_feasible_contract_is_accepted(perceived, arm, actions):
    assert verdict(perceived, arm, *actions) is None


@pytest.mark.parametrize(
    ("actions", "pointer", "hint"),
    [
        ((home, ("decline", {"reason": "no"})), "/action_sequence", "alone"),
        ((place,), "/action_sequence/0/skill", "grasp something first"),
        ((grasp(), grasp()), "/action_sequence/1/skill", "full"),
        ((grasp(), place, place), "/action_sequence/2/skill", "nothing is held"),
        ((grasp(), release, place), "/action_sequence/2/skill", "nothing is held"),
        ((grasp(opening=0.045),), "/action_sequence/0/params/opening", "wider"),
        ((grasp(object="chest", opening=0.08),), "/action_sequence/0/params/opening", "too wide for this hand"),
        ((grasp(object="plank", opening=0.08),), "/action_sequence/0/params/finger_axis", "too wide for this hand"),
        ((grasp(object="far_cube"),), "/action_sequence/0/params/object", "out of reach"),
        ((grasp(), place, grasp(object="far_cube")), "/action_sequence/2/params/object", "out of reach"),
    ],
)
def test_an_infeasible_contract_is_rejected_with_the_reason(perceived, arm, actions, pointer, hint):
    rejected = verdict(perceived, arm, *actions)
    assert (rejected.stage, rejected.pointer) == ("envelope", pointer)
    assert hint in rejected.hint
    assert rejected.allowed


def test_with_a_held_object_place_is_accepted_and_grasp_rejected(perceived):
    arm = controller_at_home("panda", perceived)
    arm.holding = HeldObject("red_cube", 0.03)
    assert verdict(perceived, arm, place) is None
    assert "full" in verdict(perceived, arm, grasp()).hint


@pytest.mark.parametrize(("limit", "accepted"), [(None, True), (60.0, True), (6.3, True), (6.2, False), (4.0, False)])
def test_an_object_that_the_least_grip_force_breaks_is_rejected(perceived, arm, limit, accepted):
    """The Panda's hand presses with at least 5 N."""
    objects = tuple(
        msgspec.structs.replace(obj, fragile_limit=limit) if obj.name == "red_cube" else obj
        for obj in perceived.objects
    )
    rejected = verdict(msgspec.structs.replace(perceived, objects=objects), arm, grasp())
    assert (rejected is None) == accepted
    assert accepted or "presses with at least 5 N" in rejected.hint


def test_the_opening_that_a_rejection_allows_is_accepted(perceived, arm):
    rejected = verdict(perceived, arm, grasp(opening=0.045))
    assert rejected.allowed["minimum"] == pytest.approx(0.04 + FINGER_MARGIN)
    assert verdict(perceived, arm, grasp(opening=rejected.allowed["minimum"])) is None


def turned_box(half_extents, quaternion):
    """A box at the usual place, with this orientation."""
    cube = box("red_cube", 0.5, -0.2, half_extents)
    return msgspec.structs.replace(cube, pose=Pose(cube.pose.position, quaternion))


UP = 0.5**0.5
"""Two equal components of a quaternion: a turn by 90 degrees."""
CUBE = (0.02, 0.02, 0.02)


@pytest.mark.parametrize(
    ("half_extents", "quaternion", "axis", "allowed", "hint"),
    [
        ((0.036, 0.02, 0.025), (1.0, 0.0, 0.0, 0.0), "along", ["across"], "too wide for this hand along this axis"),
        ((0.02, 0.036, 0.025), (1.0, 0.0, 0.0, 0.0), "across", ["along"], "too wide for this hand along this axis"),
        (CUBE, (UP, 0.0, UP, 0.0), "along", ["across"], "points up: no finger can close along it"),
        ((0.02, 0.06, 0.02), (UP, 0.0, UP, 0.0), "along", None, "across it is too wide for this hand: decline"),
    ],
)
def test_a_finger_axis_is_allowed_only_if_the_object_fits_along_it(half_extents, quaternion, axis, allowed, hint):
    perceived = scene(turned_box(half_extents, quaternion), bowl())
    arm = controller_at_home("panda", perceived)
    rejected = verdict(perceived, arm, grasp(finger_axis=axis, opening=0.08))
    assert rejected.pointer == "/action_sequence/0/params/finger_axis"
    assert rejected.hint.endswith(hint)
    assert rejected.allowed == (allowed or "an axis that is level and along which it fits between the fingers")
    other = verdict(perceived, arm, grasp(finger_axis="across" if axis == "along" else "along", opening=0.08))
    assert (other is None or "reach" in other.hint or "way" in other.hint) == (allowed is not None)


def test_the_rejection_of_an_object_that_fits_along_no_axis_allows_no_opening(perceived, arm):
    rejected = verdict(perceived, arm, grasp(object="chest", opening=0.08))
    assert rejected.allowed == "things that need 80 mm or less: chest needs 130.0 mm"


def test_reachable_objects_are_accepted():
    """On a grid over the near half of the table, every object can be grasped from above."""
    for x in (0.35, 0.5, 0.65):
        for y in (-0.3, 0.0, 0.3):
            objects = scene(box("red_cube", x, y), bowl())
            assert verdict(objects, controller_at_home("panda", objects), grasp()) is None, (x, y)


# --- the offline gate ---------------------------------------------------------------------------------------------


def offline_verdict(text):
    return msgspec.to_builtins(check_contract(text.encode(), robot="panda", scene="bare:0"))


def test_the_offline_gate_runs_all_stages():
    assert offline_verdict(contract_text(grasp(), place))["verdict"] == "accepted"
    assert offline_verdict(hold_contract())["verdict"] == "accepted"
    assert offline_verdict(decline_contract())["verdict"] == "accepted"
    assert offline_verdict("{")["stage"] == "syntax"
    assert offline_verdict(contract_text(grasp(), place, registry="00000000"))["stage"] == "authorization"
    assert offline_verdict(contract_text(grasp(opening=0.045), place))["pointer"] == "/action_sequence/0/params/opening"
    assert offline_verdict(contract_text(place))["pointer"] == "/action_sequence/0/skill"


def test_the_arm_of_the_offline_gate_is_at_home(perceived, arm):
    assert tuple(arm.observation.state.q) == load_robot("panda").home
    assert arm.observation.scene is perceived


def test_an_unreachable_clearance_is_rejected_and_the_allowed_one_accepted():
    turned = scene(box("red_cube", 0.6, -0.2, yaw=0.6), bowl())
    arm = controller_at_home("panda", turned)
    params = {"clearance": 0.35, "approach": "side", "finger_axis": "across"}
    rejected = verdict(turned, arm, grasp(**params), place)
    assert rejected is not None
    assert (rejected.stage, rejected.pointer, rejected.got) == ("envelope", "/action_sequence/0/params/clearance", 0.35)
    assert 0.03 <= rejected.allowed["maximum"] < 0.35
    assert verdict(turned, arm, grasp(**params | {"clearance": rejected.allowed["maximum"]}), place) is None


def test_an_infeasible_approach_is_rejected_and_the_allowed_ones_accepted():
    turned = scene(box("red_cube", 0.6, -0.2, yaw=0.6), bowl())
    arm = controller_at_home("panda", turned)
    params = {"clearance": 0.1, "approach": "side", "finger_axis": "along"}
    rejected = verdict(turned, arm, grasp(**params), place)
    assert rejected is not None
    assert (rejected.pointer, rejected.allowed) == ("/action_sequence/0/params/approach", ["top", "tilted"])
    for approach in rejected.allowed:
        assert verdict(turned, arm, grasp(**params | {"approach": approach}), place) is None
