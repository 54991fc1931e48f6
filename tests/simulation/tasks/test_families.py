"""The five families: every robot has scenes, words, a goal and a time limit for each level, the same each time."""

import pytest

from dualbrain.errors import UnknownNameError
from dualbrain.simulation.scenes.scene_spec import check_scene
from dualbrain.simulation.tasks.arrival import ArrivalGoal
from dualbrain.simulation.tasks.families import LEVELS, REQUEST_TYPES, TASK_FAMILIES, make_task, task_families_for

ROBOTS = ("panda", "ur5e", "base")
EVERY = [(robot, family, level) for robot in ROBOTS for family in task_families_for(robot) for level in LEVELS]


def test_the_paper_names_five_families():
    assert set(TASK_FAMILIES) == {
        "clutter_grasp",
        "edge_rescue",
        "dynamic_obstacle",
        "fragile_transfer",
        "mobile_navigation",
    }
    assert task_families_for("panda") == task_families_for("ur5e") == tuple(TASK_FAMILIES)[:4]
    assert task_families_for("base") == ("mobile_navigation",)


@pytest.mark.parametrize(("robot", "family", "level"), EVERY)
def test_the_same_seed_is_the_same_assignment_and_another_seed_another_scene(robot, family, level):
    one, again, other = (make_task(family, level, seed, robot) for seed in (7, 7, 8))
    assert one == again
    assert one.spec != other.spec
    check_scene(one.spec)
    assert one.spec.robot == robot
    assert one.time_limit > 0.0


@pytest.mark.parametrize(("robot", "family", "level"), EVERY)
def test_the_goal_names_what_is_in_the_scene(robot, family, level):
    for seed in range(6):
        given = make_task(family, level, seed, robot)
        if isinstance(given.goal, ArrivalGoal):
            assert given.spec.find_place(given.goal.place)
            continue
        assert given.spec.find(given.goal.object_name).role == "object"
        names = [thing.name for thing in given.spec.objects if thing.role == "container"]
        assert given.goal.destination in [*names, *(place.name for place in given.spec.places)]


@pytest.mark.parametrize(("robot", "family", "level"), EVERY)
@pytest.mark.parametrize("ask", REQUEST_TYPES)
def test_everything_is_asked_in_six_wordings_or_more_and_only_an_errand_has_a_goal(robot, family, level, ask):
    given = make_task(family, level, 3, robot, ask)
    said = {given.instruction(index) for index in range(len(given.templates))}
    assert len(said) == len(given.templates) >= 6
    assert not any("{" in words or "_" in words for words in said)
    assert given.instruction(len(given.templates)) == given.instruction(0)
    assert given.label == ("possible" if ask == "errand" else ask)
    assert (given.goal is not None) is (ask == "errand")


def test_consecutive_seeds_take_the_generators_in_turn():
    found = [make_task("clutter_grasp", "I", seed, "panda").spec for seed in range(6)]
    assert [spec.family for spec in found] == ["tabletop", "tall", "shelf"] * 2
    assert [spec.seed for spec in found] == [0, 0, 0, 1, 1, 1]


def test_both_arms_have_the_same_things_before_them():
    one, other = (make_task("edge_rescue", "II", 5, robot).spec for robot in ("panda", "ur5e"))
    assert one.objects == other.objects


def test_unknown_names_are_refused():
    with pytest.raises(UnknownNameError, match="mobile_navigation"):
        make_task("clutter_grasp", "I", 0, "base")
    with pytest.raises(UnknownNameError, match="level"):
        make_task("clutter_grasp", "III", 0, "panda")
    with pytest.raises(UnknownNameError, match="errand"):
        make_task("clutter_grasp", "I", 0, "panda", "nonsense")
