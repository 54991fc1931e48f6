"""The placement judge: parsing of instructions, progress by stages, success only if placed, released and at rest."""

import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Bowl
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.tasks.placement import (
    PlacementGoal,
    PlacementJudge,
    is_inside_bowl,
    parse_goal,
    score_placement,
)
from tests.simulation.scripted_hand import make_plant, pick_up, servo_to, top_down_posture, wait

IN_BOWL = PlacementGoal("red_cube", "blue_bowl")


@pytest.mark.parametrize(
    ("words", "goal"),
    [
        ("put the red cube in the blue bowl", IN_BOWL),
        ("Put red_cube into blue_bowl.", IN_BOWL),
        ("place the red cube on table left", PlacementGoal("red_cube", "table_left")),
        ("move clear_glass to table_right", PlacementGoal("clear_glass", "table_right", upright=True)),
    ],
)
def test_an_instruction_becomes_a_goal(words, goal):
    assert parse_goal(words, make_scene("fragile", 0)) == goal


def test_other_instructions_are_rejected():
    spec = make_scene("bare", 0)
    with pytest.raises(ConfigurationError, match="put THING in DESTINATION"):
        parse_goal("sing", spec)
    with pytest.raises(UnknownNameError, match="red_cube"):
        parse_goal("put the green cube in the blue bowl", spec)
    with pytest.raises(UnknownNameError, match="table_left"):
        parse_goal("put the red cube on the table lift", spec)


def put(p, name, position):
    joint = p.data.joint(name)
    joint.qpos[:3], joint.qvel[:] = position, 0.0


def test_a_cube_at_rest_in_the_bowl_is_a_success_and_a_falling_one_is_not():
    p = make_plant("bare", 0)
    bowl = np.array(p.true_pose("blue_bowl").position)
    assert score_placement(p, p.spec, IN_BOWL) == (False, 0.0)
    put(p, "red_cube", np.add(bowl, [0.02, 0, 0.05]))
    wait(p, 0.05)
    assert not score_placement(p, p.spec, IN_BOWL)[0]
    wait(p, 1.0)
    assert score_placement(p, p.spec, IN_BOWL) == (True, 1.0)


def test_beside_the_bowl_is_not_in_it():
    p = make_plant("bare", 0)
    put(p, "red_cube", np.add(p.true_pose("blue_bowl").position, [0.12, 0, 0.026]))
    wait(p, 0.5)
    assert not score_placement(p, p.spec, IN_BOWL)[0]


@pytest.mark.parametrize(("lowest", "inside"), [(None, False), (0.01, True), (0.05, False)])
def test_an_object_taller_than_the_bowl_is_inside_if_its_lowest_point_is_low(lowest, inside):
    assert is_inside_bowl((0.5, 0.2, 0.085), (0.5, 0.2, 0.0), Bowl(0.085, 0.055, 0.004), lowest=lowest) is inside


def test_the_tolerance_of_a_place_is_five_centimetres():
    for offset, placed in ((0.04, True), (0.06, False)):
        p = make_plant("bare", 0)
        spot = np.array(p.spec.find_place("table_left").position)
        put(p, "red_cube", np.add(spot, [offset, 0, 0.0255]))
        wait(p, 0.5)
        assert score_placement(p, p.spec, PlacementGoal("red_cube", "table_left"))[0] is placed


def test_a_fallen_glass_is_no_success():
    p = make_plant("fragile", 0)
    goal, spot = parse_goal("put clear glass on table left", p.spec), np.array(p.spec.find_place("table_left").position)
    put(p, "clear_glass", np.add(spot, [0, 0, 0.0455]))
    wait(p, 0.5)
    assert score_placement(p, p.spec, goal)[0]
    p.data.joint("clear_glass").qpos[3:] = [np.sqrt(0.5), np.sqrt(0.5), 0, 0]
    put(p, "clear_glass", np.add(spot, [0, 0, 0.025]))
    wait(p, 1.5)
    assert not score_placement(p, p.spec, goal)[0]


def test_progress_rises_through_a_pick_and_place():
    p = make_plant("bare", 1)
    judge = PlacementJudge(p, IN_BOWL)
    assert judge.score() == (False, 0.0)
    pick_up(p, "red_cube")
    assert judge.score() == (False, 0.75)
    bowl = np.array(p.true_pose("blue_bowl").position)
    over = top_down_posture(p, np.add(bowl, [0, 0, 0.15]), 0.0)
    servo_to(p, over, 2.0, opening=0.0)
    servo_to(p, top_down_posture(p, np.add(bowl, [0, 0, 0.045]), 0.0), 1.5, opening=0.0)
    assert not judge.score()[0], "not released"
    servo_to(p, top_down_posture(p, np.add(bowl, [0, 0, 0.045]), 0.0), 0.8)
    servo_to(p, over, 1.0)
    assert judge.score() == (True, 1.0)
