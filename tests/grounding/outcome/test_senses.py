"""Each sense by itself, and the check of an outcome that they give together."""

from dataclasses import replace as replace_fields
from types import SimpleNamespace

import msgspec
import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.core.geometry.shapes import Box, Cylinder
from dualbrain.grounding.outcome.outcome_check import (
    SENSES,
    check_outcome,
    collect_evidence,
    combine_verdicts,
    expected_placements,
)
from dualbrain.grounding.outcome.sense_held import judge_held
from dualbrain.grounding.outcome.sense_intact import judge_intact
from dualbrain.grounding.outcome.sense_placed import judge_placed
from dualbrain.grounding.outcome.sense_undisturbed import judge_undisturbed
from dualbrain.memory.learning.trust import TrustConfig
from dualbrain.records import Outcome, SenseVerdict
from dualbrain.robots.loader import load_robot
from tests.grounding.outcome.tabletop_cases import BEFORE, HOME, evidence, grip, holding, scene_after, with_placements

CUBE_IN = {"red_cube": "in the bowl"}
PANDA = load_robot("panda")


def contract(*steps):
    actions = tuple(Action(skill, params) for skill, params in steps)
    return Contract("c-0001", Context("panda", "x" * 8), actions)


def put(name, destination):
    return ("grasp", {"object": name}), ("place", {"destination": destination})


# --- placed -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("where", "destination", "expected"),
    [
        ("in the bowl", "blue_bowl", "confirmed"),
        ("right of the bowl", "blue_bowl", "contradicted"),
        ("on the rim", "blue_bowl", "not judged"),  # inside or outside: within the error
        ("above the bowl", "blue_bowl", "contradicted"),  # right in the plane, but too high
        ("table_left", "table_left", "confirmed"),
        ("table_right", "table_left", "contradicted"),
    ],
)
def test_placed_compares_the_perceived_pose_with_the_destination(where, destination, expected):
    one = with_placements(evidence({"red_cube": where}), red_cube=destination)
    assert judge_placed(one).verdict == expected


def test_an_object_in_the_hand_is_not_placed():
    one = with_placements(evidence({"red_cube": "in the bowl"}, hand="red_cube"), red_cube="blue_bowl")
    assert judge_placed(one).verdict == "contradicted"


def test_placed_does_not_judge_without_a_placement_or_a_perceived_object():
    assert judge_placed(evidence(CUBE_IN)).verdict == "not judged"
    vanished = with_placements(evidence(CUBE_IN, gone=("red_cube",)), red_cube="blue_bowl")
    assert judge_placed(vanished).verdict == "not judged"
    assert expected_placements(contract(*put("red_cube", "blue_bowl"), *put("red_cube", "table_left"))) == {
        "red_cube": "table_left"
    }
    held = contract(*put("red_cube", "blue_bowl"), ("grasp", {"object": "red_cube"}))
    assert expected_placements(held) == {}
    assert expected_placements(contract(("place", {"destination": "blue_bowl"})), "red_cube") == {
        "red_cube": "blue_bowl"
    }


# --- intact -----------------------------------------------------------------------------------------------------------


def glass_moved(*, after_shape=None, gone=(), fallen=(), **fields):
    one = evidence({"clear_glass": "table_left"}, gone=gone, fallen=fallen, grips=(grip("clear_glass", **fields),))
    if after_shape is None:
        return one
    objects = tuple(
        msgspec.structs.replace(obj, shape=after_shape) if obj.name == "clear_glass" else obj
        for obj in one.after.objects
    )
    return replace_fields(one, after=msgspec.structs.replace(one.after, objects=objects))


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"force": 9.0}, "confirmed"),
        ({"force": 60.0}, "contradicted"),  # the glass breaks at 20 N
        ({"force": 19.5}, "contradicted"),  # the pads are sampled: the peak may be higher
        ({"force": 9.0, "fastest_closing": 0.006}, "contradicted"),  # the gap collapsed
        ({"force": 9.0, "after_shape": Cylinder(0.024, 0.012)}, "contradicted"),  # a heap of shards
        ({"force": 9.0, "gone": ("clear_glass",)}, "contradicted"),
        ({"force": 9.0, "fallen": ("clear_glass",)}, "contradicted"),
        ({"force": 0.0}, "not judged"),  # no force sensor
    ],
)
def test_intact_reads_force_profile_gap_and_the_object_afterwards(fields, expected):
    assert judge_intact(glass_moved(**fields)).verdict == expected


def test_a_grip_of_an_earlier_try_that_broke_the_object_is_not_forgotten():
    gentle = glass_moved(force=9.0)
    assert judge_intact(replace_fields(gentle, earlier_grips=(grip("clear_glass", 60.0),))).verdict == "contradicted"
    assert judge_intact(replace_fields(gentle, earlier_grips=(grip("clear_glass", 9.0),))).verdict == "confirmed"
    assert judge_intact(replace_fields(gentle, grips=(), earlier_grips=gentle.grips)).verdict == "confirmed"


def test_a_robust_object_may_be_gripped_firmly():
    assert judge_intact(evidence(CUBE_IN, grips=(grip("red_cube", 60.0),))).verdict == "confirmed"
    crushed = evidence(CUBE_IN, grips=(grip("red_cube", 60.0, fastest_closing=0.004),))
    assert judge_intact(crushed).verdict == "contradicted"
    assert judge_intact(evidence({})).verdict == "not judged"


def test_a_toppled_glass_in_a_bowl_or_in_the_hand_is_intact():
    lying = {"fallen": ("clear_glass",), "grips": (grip("clear_glass", 9.0),)}
    one = evidence({"clear_glass": "in the bowl"}, **lying)
    assert judge_intact(with_placements(one, clear_glass="blue_bowl")).verdict == "confirmed"
    assert judge_intact(with_placements(one, clear_glass="table_left")).verdict == "contradicted"
    held = evidence(hand="clear_glass", **lying | {"grips": (holding("clear_glass", 9.0),)})
    assert judge_intact(held).verdict == "confirmed"


def test_a_robust_object_that_is_no_longer_perceived_is_not_judged():
    one = evidence(CUBE_IN, gone=("red_cube",), grips=(grip("red_cube"),))
    assert judge_intact(one).verdict == "not judged"


# --- held, undisturbed ------------------------------------------------------------------------------------------------


def test_held_reads_the_fingers_after_the_motion():
    assert judge_held(evidence(hand="red_cube")).verdict == "confirmed"
    lost = grip("red_cube", released=False, end_force=0.0, end_opening=0.0)
    assert judge_held(evidence({"red_cube": "3 cm ahead"}, grips=(lost,))).verdict == "contradicted"
    assert judge_held(evidence(CUBE_IN)).verdict == "not judged"
    twice = evidence(hand="red_cube", grips=(grip("green_tin"), holding("red_cube")))
    assert judge_held(twice).verdict == "confirmed"  # the last grip counts


@pytest.mark.parametrize(
    ("moves", "fallen", "gone", "expected"),
    [
        ({}, (), (), "confirmed"),
        ({"green_tin": "far away"}, (), (), "contradicted"),
        ({"blue_bowl": "far away"}, (), (), "contradicted"),
        ({}, ("green_tin",), (), "contradicted"),
        ({}, (), ("green_tin",), "not judged"),
    ],
)
def test_undisturbed_looks_at_every_other_object(moves, fallen, gone, expected):
    one = evidence(CUBE_IN | moves, fallen=fallen, gone=gone)
    assert judge_undisturbed(one, frozenset({"red_cube"})).verdict == expected
    assert judge_undisturbed(one, frozenset(one.movable_names)).verdict == "not judged"


# --- together ---------------------------------------------------------------------------------------------------------


def check(instruction, kind, moves, *, steps, grips, before=BEFORE, held=None, **scene):
    outcome = Outcome(kind=kind, reason="", grips=grips)
    plan = contract(*steps)
    one = collect_evidence(before, scene_after(moves, **scene), plan, outcome, HOME, HOME + 0.3, PANDA, held=held)
    return check_outcome(instruction, outcome, plan, one)


def test_a_confirmed_success_agrees_and_names_every_sense():
    found = check(
        "put the red cube in the bowl",
        "succeeded",
        CUBE_IN,
        steps=put("red_cube", "blue_bowl"),
        grips=(grip("red_cube"),),
    )
    assert found.check == "agrees"
    assert tuple(one.sense for one in found.verdicts) == SENSES
    assert found.changes == "red cube in blue bowl; nothing else moved"


@pytest.mark.parametrize(
    ("instruction", "moves", "steps", "grips"),
    [
        (
            "put the glass on the left side of the table",  # broken with 60 N, and placed
            {"clear_glass": "table_left"},
            put("clear_glass", "table_left"),
            (grip("clear_glass", 60.0),),
        ),
        ("put the red cube in the bowl", {"red_cube": "right of the bowl"}, put("red_cube", "blue_bowl"), ()),
        ("put the red cube in the bowl", CUBE_IN | {"green_tin": "far away"}, put("red_cube", "blue_bowl"), ()),
        ("put the red cube to the left of the bowl", CUBE_IN, put("red_cube", "blue_bowl"), (grip("red_cube"),)),
    ],
)
def test_a_false_success_is_disputed_and_quarantined(instruction, moves, steps, grips):
    found = check(instruction, "succeeded", moves, steps=steps, grips=grips)
    assert found.check == "disagrees"
    episode = SimpleNamespace(outcome=Outcome(kind="succeeded", reason=""), second_opinion=found.check)
    assert TrustConfig().initial_status(episode) == "quarantined"


def test_a_success_that_cannot_be_read_stays_a_candidate():
    found = check(
        "tidy up a little", "succeeded", CUBE_IN, steps=put("red_cube", "blue_bowl"), grips=(grip("red_cube"),)
    )
    assert found.check == "none"
    episode = SimpleNamespace(outcome=Outcome(kind="succeeded", reason=""), second_opinion=found.check)
    assert TrustConfig().initial_status(episode) == "candidate"


def test_a_success_without_a_finger_force_stays_a_candidate():
    grips = (grip("red_cube", 0.0),)
    found = check("put the red cube in the bowl", "succeeded", CUBE_IN, steps=put("red_cube", "blue_bowl"), grips=grips)
    assert found.check == "none"


def test_a_failure_that_carried_out_the_request_is_disputed():
    steps, grips = put("red_cube", "blue_bowl"), (grip("red_cube"),)
    assert check("put the red cube in the bowl", "failed", CUBE_IN, steps=steps, grips=grips).check == "disagrees"
    assert check("put the red cube in the bowl", "failed", {}, steps=steps, grips=()).check == "agrees"


@pytest.mark.parametrize("bad", SENSES)
def test_no_success_agrees_against_one_sense(bad):
    verdicts = tuple(SenseVerdict(name, "contradicted" if name == bad else "confirmed", "") for name in SENSES)
    assert combine_verdicts(Outcome(kind="succeeded", reason=""), verdicts, gripped=True) == "disagrees"


def confirmed(*, contradicted=()):
    """The verdicts of all senses, confirmed except `contradicted`."""
    return tuple(SenseVerdict(name, "contradicted" if name in contradicted else "confirmed", "") for name in SENSES)


@pytest.mark.parametrize(
    ("kind", "contradicted", "expected"),
    [
        ("succeeded", (), "agrees"),
        ("paused", (), "agrees"),
        ("slowed", ("undisturbed",), "disagrees"),
        ("failed", (), "disagrees"),
        ("taken_over", ("undisturbed",), "none"),  # carried out, with something else disturbed: no clear failure
        ("failed", ("fulfilled",), "agrees"),
        ("stopped", ("fulfilled",), "none"),
        ("declined", (), "none"),
    ],
)
def test_the_senses_agree_or_disagree_with_the_kind_of_the_outcome(kind, contradicted, expected):
    outcome = Outcome(kind=kind, reason="")
    assert combine_verdicts(outcome, confirmed(contradicted=contradicted), gripped=True) == expected


def test_a_success_needs_the_sense_intact_only_if_something_was_gripped():
    verdicts = tuple(SenseVerdict(one.sense, "not judged", "") if one.sense == "intact" else one for one in confirmed())
    outcome = Outcome(kind="succeeded", reason="")
    assert combine_verdicts(outcome, verdicts, gripped=True) == "none"
    assert combine_verdicts(outcome, verdicts, gripped=False) == "agrees"


@pytest.mark.parametrize(("unjudged", "expected"), [("fulfilled", "agrees"), ("placed", "none")])
def test_without_an_instruction_the_destination_of_the_contract_is_the_request(unjudged, expected):
    verdicts = tuple(SenseVerdict(one.sense, "not judged", "") if one.sense == unjudged else one for one in confirmed())
    outcome = Outcome(kind="succeeded", reason="")
    assert combine_verdicts(outcome, verdicts, gripped=True, instructed=False) == expected


def test_the_objects_of_the_request_may_move_although_the_contract_handles_another():
    """A contract for another object: the sense "undisturbed" leaves out both, the sense "fulfilled" contradicts."""
    moves = {"yellow_block": "in the bowl", "red_cube": "3 cm ahead"}
    steps, grips = put("yellow_block", "blue_bowl"), (grip("yellow_block"),)
    found = check("put the red cube in the bowl", "succeeded", moves, steps=steps, grips=grips)
    assert {one.sense: one.verdict for one in found.verdicts}["undisturbed"] == "confirmed"
    assert found.check == "disagrees"


def test_a_box_is_not_a_cylinder_afterwards():
    """A change of the fitted shape alone is no loss of height: depth perception fits a shape to each image."""
    one = glass_moved(force=9.0, after_shape=Box((0.024, 0.024, 0.012)))
    assert judge_intact(one).verdict == "confirmed"


def test_the_hand_that_holds_is_part_of_the_evidence():
    outcome = Outcome(kind="succeeded", reason="", grips=(holding("red_cube"),))
    one = collect_evidence(
        BEFORE, scene_after({}), contract(("grasp", {"object": "red_cube"})), outcome, HOME, HOME, PANDA
    )
    assert one.in_hand == "red_cube"
    released = msgspec.structs.replace(outcome, grips=(grip("red_cube"),))
    assert collect_evidence(BEFORE, scene_after({}), contract(), released, HOME, HOME, PANDA).in_hand == ""


# --- in the hand at the beginning -------------------------------------------------------------------------------------


def check_held(instruction, moves, *steps, grips):
    """The check of a contract that began with the red cube in the hand, above its place in `BEFORE`."""
    lifted = scene_after({"red_cube": "lifted"})
    found = check(instruction, "succeeded", moves, steps=steps, grips=grips, before=lifted, held="red_cube")
    return found.check, {one.sense: one.verdict for one in found.verdicts}


TO_BOWL = ("place", {"destination": "blue_bowl"})


@pytest.mark.parametrize("instruction", ["put the red cube in the bowl", ""])
def test_an_object_in_the_hand_at_the_beginning_is_judged_when_it_is_placed(instruction):
    done, verdicts = check_held(instruction, CUBE_IN, TO_BOWL, grips=(grip("red_cube"),))
    assert done == "agrees"
    assert (verdicts["placed"], verdicts["intact"], verdicts["undisturbed"]) == ("confirmed",) * 3
    missed, verdicts = check_held(instruction, {"red_cube": "right of the bowl"}, TO_BOWL, grips=(grip("red_cube"),))
    assert (missed, verdicts["placed"]) == ("disagrees", "contradicted")
    crushed, verdicts = check_held(instruction, CUBE_IN, TO_BOWL, grips=(grip("red_cube", fastest_closing=0.006),))
    assert (crushed, verdicts["intact"]) == ("disagrees", "contradicted")


@pytest.mark.parametrize(
    ("where", "grips", "expected"),
    [
        ("lifted", (holding("red_cube"),), "agrees"),
        ("3 cm ahead", (holding("red_cube"),), "disagrees"),  # on the table
        ("lifted", (grip("red_cube", released=False),), "disagrees"),
    ],
)
def test_an_object_that_was_in_the_hand_is_held_if_it_still_is_above_the_table(where, grips, expected):
    moves, still = {"red_cube": where}, ("hold", {"duration": 1.0})
    assert check_held("hold the red cube", moves, still, grips=grips)[0] == expected


def test_an_object_that_stays_in_the_hand_is_not_disturbed_by_a_motion_of_the_arm():
    moves, carry = {"red_cube": "above the bowl"}, ("move_to", {"target": "blue_bowl"})
    _, verdicts = check_held("move above the blue bowl", moves, carry, grips=(holding("red_cube"),))
    assert "contradicted" not in verdicts.values()
    _, verdicts = check_held("move above the blue bowl", moves | CUBE_IN, carry, grips=(grip("red_cube"),))
    assert verdicts["fulfilled"] == "contradicted"


def test_an_object_that_a_try_before_grasped_was_not_in_the_hand_at_the_beginning():
    """The scene before is that of the first try; the object in the hand has left its place."""
    plan, outcome = (
        contract(("hold", {"duration": 1.0})),
        Outcome(kind="failed", reason="", grips=(holding("red_cube"),)),
    )
    one = collect_evidence(
        BEFORE, scene_after({"red_cube": "lifted"}), plan, outcome, HOME, HOME, PANDA, held="red_cube"
    )
    later = replace_fields(one, in_hand_before="")
    verdicts = {one.sense: one.verdict for one in check_outcome("stop", outcome, plan, later).verdicts}
    assert (verdicts["fulfilled"], verdicts["held"]) == ("contradicted", "confirmed")
