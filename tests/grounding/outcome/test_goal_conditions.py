"""Single conditions of a goal against the perceived end of an episode: true, false, or undecided."""

from dataclasses import replace as replace_fields

import numpy as np
import pytest

from dualbrain.grounding.instruction.goals.goal import Held, Observed, Placed, Pushed, RobotEnds
from dualbrain.grounding.instruction.goals.goal_reading import read_goal
from dualbrain.grounding.outcome.evidence import arm_home, base_position
from dualbrain.grounding.outcome.goal_conditions import ARRIVAL_DISTANCE, condition_holds
from dualbrain.grounding.outcome.sense_fulfilled import judge_fulfilled
from dualbrain.robots.loader import load_robot
from tests.grounding.outcome.tabletop_cases import BEFORE, HOME, evidence

CUBE, BLOCKS, CUBE_IN = ("red_cube",), ("red_block", "yellow_block"), {"red_cube": "in the bowl"}
IN_BOWL = Placed(CUBE, "in", ("blue_bowl",))


@pytest.mark.parametrize("fact", ["touched", "unsettled"])
def test_an_object_that_is_touched_or_still_moves_is_not_placed(fact):
    assert condition_holds(IN_BOWL, evidence(CUBE_IN)) is True
    assert condition_holds(IN_BOWL, replace_fields(evidence(CUBE_IN), **{fact: frozenset(CUBE)})) is False


def test_an_object_in_the_hand_is_not_placed():
    assert condition_holds(IN_BOWL, evidence(CUBE_IN, hand="red_cube")) is False


@pytest.mark.parametrize(
    ("moves", "expected"),
    [
        ({}, False),
        ({"red_block": "in the bowl"}, True),
        ({"red_block": "in the bowl", "yellow_block": "in the bowl"}, False),
        ({"red_block": "on the rim"}, None),  # within the error it is inside
        ({"red_block": "in the bowl", "yellow_block": "on the rim"}, None),
    ],
)
def test_a_number_of_objects_is_neither_more_nor_less(moves, expected):
    assert condition_holds(Placed(BLOCKS, "in", ("blue_bowl",), 1), evidence(moves)) is expected


@pytest.mark.parametrize(
    ("where", "directions"),
    [
        ("pushed to the bowl", {"left", "toward"}),  # 8 cm to the left: towards the bowl
        ("pushed away", {"forward", "away_from", "right"}),
    ],
)
def test_a_push_has_a_direction(where, directions):
    for direction in ("left", "right", "forward", "backward", "toward", "away_from"):
        reference = "blue_bowl" if direction in ("toward", "away_from") else ""
        found = condition_holds(Pushed(CUBE, direction, reference), evidence({"red_cube": where}))
        assert (found is True) == (direction in directions), direction


@pytest.mark.parametrize("end", [{"hand": "red_cube"}, {"moves": {"red_cube": "in the bowl"}}])
def test_an_object_in_the_hand_or_in_a_container_was_not_pushed(end):
    one = evidence(**{"moves": {"red_cube": "pushed to the bowl"}} | end)
    assert condition_holds(Pushed(CUBE, "left"), one) is False


def test_an_object_that_fell_off_the_table_was_not_pushed():
    on_table, on_floor, at_edge = (evidence({"red_cube": where}) for where in ("pushed away", "on the floor", "sunk"))
    for direction, reference in (("right", ""), ("forward", ""), ("away_from", "blue_bowl")):
        pushed = Pushed(CUBE, direction, reference)
        assert condition_holds(pushed, on_table) is True
        assert condition_holds(pushed, on_floor) is False
        assert condition_holds(pushed, at_edge) is None  # on the table or beside it: within the error
    assert judge_fulfilled(read_goal("push the red cube to the right", BEFORE), on_floor).verdict == "contradicted"


def test_an_object_that_is_observed_stays_where_it_was():
    assert condition_holds(Observed("red_cube"), evidence({"red_cube": "3 cm ahead"} | CUBE_IN)) is False
    assert condition_holds(Observed("red_cube"), evidence({})) is None  # no sensor shows the intention of the hand


@pytest.mark.parametrize(("where", "expected"), [("lifted", True), ("3 cm ahead", False)])
def test_an_object_in_the_hand_is_held_up(where, expected):
    assert condition_holds(Held(CUBE), evidence({"red_cube": where}, hand="red_cube")) is expected


@pytest.mark.parametrize("relation", ["at", "near"])
def test_an_object_that_toppled_is_not_at_its_place_but_may_be_near_it(relation):
    tin = Placed(("green_tin",), relation, ("table_left",))
    assert condition_holds(tin, evidence({"green_tin": "table_left"})) is True
    toppled = evidence({"green_tin": "table_left"}, fallen=("green_tin",))
    assert condition_holds(tin, toppled) is (relation == "near")


def test_a_base_arrives_within_a_distance_of_the_place():
    left = RobotEnds("drive", "table_left")
    for away, expected in ((0.5 * ARRIVAL_DISTANCE, True), (1.5 * ARRIVAL_DISTANCE, False)):
        assert condition_holds(left, replace_fields(evidence(), base_after=(0.36, 0.46 - away))) is expected
    assert condition_holds(left, evidence()) is None
    assert condition_holds(RobotEnds("drive", "nowhere"), replace_fields(evidence(), base_after=(0.0, 0.0))) is None


def test_home_and_rest_are_those_of_the_arm_and_not_of_its_base():
    """A mobile manipulator rests at any place; its configuration begins with that of the base."""
    base = np.array([1.0, 2.0, 0.3])
    there = replace_fields(evidence(), q_before=np.zeros(10), q_after=np.concatenate([base, HOME]))
    assert condition_holds(RobotEnds("home"), there) is True
    assert condition_holds(RobotEnds("rest"), there) is True
    assert condition_holds(RobotEnds("still"), there) is False
    away = replace_fields(there, q_after=np.concatenate([base, HOME + 0.2]))
    assert condition_holds(RobotEnds("home"), away) is False
    assert condition_holds(RobotEnds("home"), replace_fields(there, home=np.zeros(0))) is None


def test_the_position_of_the_base_is_not_part_of_the_arm():
    panda, mobile = load_robot("panda"), load_robot("mobile_panda")
    assert base_position(panda, np.array(panda.home)) is None
    assert arm_home(panda).tolist() == list(panda.home)
    assert base_position(mobile, np.array([1.0, 2.0, 0.3, *panda.home])) == (1.0, 2.0)
    assert arm_home(mobile).tolist() == list(mobile.home[3:])
    assert len(arm_home(load_robot("base"))) == 0
