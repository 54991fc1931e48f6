"""Several goals: parsing into stages, conditions and groups of a scene, and judging of order and final state."""

import numpy as np
import pytest

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.scenes.generators.rooms import make_room
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.tasks.arrival import ArrivalGoal
from dualbrain.simulation.tasks.multi_goal import GoalSequence, GoalSequenceJudge, HomeGoal, parse_goals
from dualbrain.simulation.tasks.placement import PlacementGoal
from tests.simulation.scripted_hand import PANDA, Plant, wait

FREE_BOWL, OCCUPIED_BOWL = make_scene("sorting", 0), make_scene("sorting", 1)
CUBE, BLOCK = PlacementGoal("red_cube", "blue_bowl"), PlacementGoal("yellow_block", "table_left")
TWO_STAGES = "put the red cube in the blue bowl, then put the yellow block on the table left"


def reds(spec):
    return tuple(PlacementGoal(obj.name, "blue_bowl") for obj in spec.objects if obj.colour == "red")


@pytest.mark.parametrize(
    ("words", "goal"),
    [
        ("put the red cube in the blue bowl", CUBE),
        (TWO_STAGES, GoalSequence(((CUBE,), (BLOCK,)))),
        ("put red_cube in blue_bowl and put yellow_block on table_left", GoalSequence(((CUBE, BLOCK),))),
        ("put red cube in blue bowl and then go home", GoalSequence(((CUBE,), (HomeGoal(),)))),
        ("put all the red things in the blue bowl", GoalSequence((reds(FREE_BOWL),))),
        ("put all red ones in the blue bowl, then go home.", GoalSequence((reds(FREE_BOWL), (HomeGoal(),)))),
        ("if the blue bowl is free, put red cube in blue bowl, else put red cube on table left", CUBE),
        ("if blue bowl is occupied put red cube on table_left", GoalSequence(())),
    ],
)
def test_instructions_become_stages(words, goal):
    assert parse_goals(words, FREE_BOWL) == goal


def test_a_condition_is_evaluated_in_the_scene():
    words = "if the blue bowl is free put red cube in blue bowl otherwise put red cube on table left"
    assert parse_goals(words, FREE_BOWL) == CUBE
    assert parse_goals(words, OCCUPIED_BOWL) == PlacementGoal("red_cube", "table_left")


def test_unknown_groups_names_and_forms_are_rejected():
    with pytest.raises(ConfigurationError, match="colour or category"):
        parse_goals("put all the purple things in the blue bowl", FREE_BOWL)
    with pytest.raises(UnknownNameError, match="red_cube"):
        parse_goals("put red cube in blue bowl, then put green cube in blue bowl", FREE_BOWL)
    with pytest.raises(ConfigurationError, match="put THING in DESTINATION"):
        parse_goals("sing, then dance", FREE_BOWL)


def test_a_base_goes_to_several_places():
    spec = make_room("empty_room", 0, "base")
    assert parse_goals("go to the shelf, then go to the charger", spec) == GoalSequence(
        ((ArrivalGoal("shelf"),), (ArrivalGoal("charger"),))
    )
    assert parse_goals("go to the shelf", spec) == ArrivalGoal("shelf")


def put(p, name, position):
    joint = p.data.joint(name)
    joint.qpos[:3], joint.qvel[:] = position, 0.0


def into_bowl(p, name):
    put(p, name, np.add(p.true_pose("blue_bowl").position, [0.0, 0.0, 0.06]))


def to_left(p, name):
    put(p, name, np.add(p.spec.find_place("table_left").position, [0.0, 0.0, p.spec.find(name).position[2] + 0.002]))


@pytest.mark.parametrize(("first", "second", "right"), [(into_bowl, to_left, True), (to_left, into_bowl, False)])
def test_the_order_counts_and_every_goal_must_hold_at_the_end(first, second, right):
    p = Plant(FREE_BOWL, PANDA)
    objects = {into_bowl: "red_cube", to_left: "yellow_block"}
    ordered, free = (
        GoalSequenceJudge(p, parse_goals(TWO_STAGES, FREE_BOWL)),
        GoalSequenceJudge(p, GoalSequence(((CUBE, BLOCK),))),
    )
    for move in (first, second):
        assert not ordered.score()[0]
        move(p, objects[move])
        wait(p, 0.6)
        for one in (ordered, free):
            one.update()
    assert free.score() == (True, 1.0)
    assert ordered.score()[0] == right
    put(p, "red_cube", (0.6, 0.0, 0.026))
    wait(p, 0.4)
    success, progress = ordered.score()
    assert not success
    assert 0.0 < progress < 1.0


def test_all_objects_of_a_colour_must_be_placed():
    p = Plant(FREE_BOWL, PANDA)
    judge = GoalSequenceJudge(p, parse_goals("put all the red things in the blue bowl", FREE_BOWL))
    for goal in reds(FREE_BOWL):
        assert not judge.score()[0]
        into_bowl(p, goal.object_name)
        wait(p, 0.8)
    assert judge.score() == (True, 1.0)


def test_home_and_moving_nothing_are_goals():
    p = Plant(FREE_BOWL, PANDA)
    home, nothing = GoalSequenceJudge(p, GoalSequence(((HomeGoal(),),))), GoalSequenceJudge(p, GoalSequence(()))
    assert home.score() == nothing.score() == (True, 1.0)
    p.set_configuration(np.array(load_robot("panda").home) + 0.2)
    to_left(p, "red_cube")
    wait(p, 0.05)
    assert home.score() == nothing.score() == (False, 0.0)


@pytest.mark.parametrize("seed", range(4))
def test_a_sorting_scene_starts_without_overlap_and_stays_at_rest(seed):
    p = Plant(make_scene("sorting", seed), PANDA)
    assert not [contact.dist for contact in p.data.contact if contact.dist < -1e-4]
    before = {name: np.array(p.true_pose(name).position) for name in p.object_names}
    wait(p, 0.4)
    assert all(np.linalg.norm(np.array(p.true_pose(name).position) - at) < 3e-3 for name, at in before.items())


def test_every_second_sorting_scene_has_an_occupied_bowl():
    for seed in range(6):
        taken = parse_goals("if blue bowl is occupied put red cube on table left", make_scene("sorting", seed))
        assert (taken == PlacementGoal("red_cube", "table_left")) == bool(seed % 2)
