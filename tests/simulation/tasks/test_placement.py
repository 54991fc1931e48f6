"""The placement judge: parsing of instructions, progress by stages, success only if placed, released and at rest."""

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Bowl, Box
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.records import Place
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.plant.factory import make_plant as make_room_plant
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.scenes.generators.workroom import TABLE_SHAPE, make_workroom
from dualbrain.simulation.scenes.scene_spec import ObjectSpec
from dualbrain.simulation.scenes.supports import support_height
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


def room():
    """A workroom with the robot, and a place on its table beside those on the floor."""
    robot = load_robot("mobile_panda")
    spec = make_workroom("workroom", 0, robot.name)
    table = spec.find("table").position
    on_table = Place("table_middle", (table[0], table[1], 2.0 * TABLE_SHAPE.half_extents[2]))
    return make_room_plant(msgspec.structs.replace(spec, places=(*spec.places, on_table)), robot)


@pytest.mark.parametrize(
    ("place", "height", "placed"),
    [("table_middle", 0.5255, True), ("bench", 0.0255, False), ("bench", 0.5255, False)],
)
def test_an_object_is_placed_on_a_support_and_not_on_the_floor_of_a_room(place, height, placed):
    p = room()
    x, y, _ = p.spec.find_place(place).position
    put(p, "red_cube", (x, y, height))
    wait(p, 1.0)
    assert score_placement(p, p.spec, PlacementGoal("red_cube", place))[0] is placed


def test_an_object_in_a_bowl_on_the_floor_is_not_placed():
    p = room()
    bowl = np.array(p.true_pose("blue_bowl").position)
    put(p, "red_cube", np.add(bowl, [0.0, 0.0, 0.03]))
    wait(p, 0.5)
    assert score_placement(p, p.spec, IN_BOWL)[0]
    spot = np.array(p.spec.find_place("bench").position)
    put(p, "blue_bowl", np.add(spot, [0.0, 0.0, 0.002]))
    put(p, "red_cube", np.add(spot, [0.0, 0.0, 0.032]))
    wait(p, 0.5)
    assert not score_placement(p, p.spec, IN_BOWL)[0]


def test_an_object_on_another_one_is_not_at_the_place():
    p = make_plant("sorting", 0)
    spot = np.array(p.spec.find_place("table_left").position)
    lower, upper = "red_block", "yellow_block"
    put(p, lower, np.add(spot, [0, 0, 0.0205]))
    put(p, upper, np.add(spot, [0, 0, 0.0610]))
    wait(p, 0.5)
    assert score_placement(p, p.spec, PlacementGoal(lower, "table_left"))[0]
    assert not score_placement(p, p.spec, PlacementGoal(upper, "table_left"))[0]


@pytest.mark.parametrize(("y", "height"), [(0.0, 0.0), (0.64, 0.0), (0.66, None)])
def test_the_height_of_a_support_ends_at_its_edge(y, height):
    assert support_height(make_scene("bare", 0), 0.5, y) == height


@pytest.mark.parametrize(("at", "height"), [((0.5, 0.18), 0.3), ((0.5, 0.22), 0.0), ((0.68, 0.0), 0.0)])
def test_a_turned_support_covers_its_own_area(at, height):
    turn = (float(np.cos(np.pi / 4)), 0.0, 0.0, float(np.sin(np.pi / 4)))
    stand = ObjectSpec(
        name="stand", role="support", shape=Box((0.2, 0.1, 0.15)), position=(0.5, 0.0, 0.15), mass=5.0, colour="oak",
        category="stand", quaternion=turn, fixed=True,
    )  # fmt: skip
    spec = make_scene("bare", 0)
    spec = msgspec.structs.replace(spec, objects=(*spec.objects, stand))
    assert support_height(spec, *at) == pytest.approx(height)
